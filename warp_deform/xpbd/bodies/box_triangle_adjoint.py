"""Adjoint of contact between boxes and triangles, see `box_triangle`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.closest_point import closest_point
from ..contact.table_support import table_support
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import BODY_WORDS, BOX_TRIANGLE_SCALARS, Kind, tape
from .box_particle import box_particle
from .box_particle_adjoint import box_particle_adjoint
from .box_triangle import box_triangle
from .overlap_recovery import overlap_recovery

__all__ = ["box_triangle_adjoint"]


@functools.cache
def box_triangle_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_box_triangles` solves the triangles of one lane against one box, leaves those that
    met it on the tape, and returns their number; `sweep_box_triangle` takes one back and returns
    the derivative by friction. `number`: of the shape in its world.

    Branches: the axis that separates best; beside each other or overlapping; inside, edge or corner
    of the triangle; depth limited by the overlap or by `recovery`; corners that the table carries.
    """
    t = structures(scalar, lanes)
    S, R3, Q = t.S, t.R3, t.Q
    Shapes, Bodies, Topology, Sheets = t.Shapes, t.Bodies, t.Topology, t.Sheets
    Cells, Tape, Adjoint, BodyAdjoint = t.Cells, t.Tape, t.Adjoint, t.BodyAdjoint
    access = lane_access(scalar, lanes)
    count_one = access.count_one
    get, put, get_mass = access.get, access.put, access.get_mass
    barycentric = closest_point(scalar, lanes).barycentric
    stands = box_particle(scalar, lanes).stands
    raised = table_support(scalar, lanes).raised
    correction = overlap_recovery(scalar).correction
    solve = box_triangle(scalar, lanes)
    separate, corner_towards = solve.separate, solve.corner_towards
    project_box_triangle, next_near = solve.project_box_triangle, solve.next_near
    particle_ = box_particle_adjoint(scalar, lanes)
    stick_share, response_of = particle_.stick_share, particle_.response_of
    impulse_loss, add_radius = particle_.impulse_loss, particle_.add_radius
    BodyValue, taped_body = particle_.BodyValue, particle_.taped_body
    BoxValue, box_value = particle_.BoxValue, particle_.box_value
    add_to_body, add_mass = particle_.add_to_body, particle_.add_mass
    tape_ = tape(scalar, lanes)
    record_pose, position = tape_.record_pose, tape_.position

    @wp.struct
    class Corners:
        """A triangle's corners before the contact, where they began the substep, inverse masses."""

        a: R3
        b: R3
        c: R3
        a_start: R3
        b_start: R3
        c_start: R3
        wa: S
        wb: S
        wc: S

    @wp.struct
    class AfterContact:
        """Derivatives of the loss by the corners and the pose after the contact."""

        a: R3
        b: R3
        c: R3
        x: R3
        q: Q

    @wp.func
    def record_box_triangles(
        word: int,
        at: int,
        lane: int,
        k: int,
        p0: int,
        radii: int,
        shape: int,
        number: int,
        b: int,
        wide: S,
        mu: S,
        max_recovery: S,
        top: Topology,
        shapes: Shapes,
        bodies: Bodies,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        count = int(0)
        center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
        end = sheets.first[k + 1]
        f = next_near(sheets.triangle, cells.x, sheets.first[k], end, p0, lane, center, wide)
        while f < end:
            tri = sheets.triangle[f]
            # what does not meet the box is overwritten by the next one
            s = at + count * wp.static(BOX_TRIANGLE_SCALARS)
            for corner in range(3):
                x = get(cells.x, p0 + tri[corner], lane)
                for axis in range(3):
                    tape.s[s + 3 * corner + axis] = x[axis]
            record_pose(s + 9, bodies.x[b], bodies.q[b], tape)
            if project_box_triangle(
                f,
                lane,
                p0,
                radii,
                shape,
                b,
                center,
                mu,
                max_recovery,
                top,
                shapes,
                bodies,
                sheets,
                cells,
            ):
                center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
                tape.k[word + count * wp.static(BODY_WORDS)] = -1 - f
                tape.k[word + count * wp.static(BODY_WORDS) + 1] = number
                count += 1
            f = next_near(sheets.triangle, cells.x, f + 1, end, p0, lane, center, wide)
        return count

    @wp.func
    def axis_of(kind: int, a: R3, e: R3, c: R3):
        """Axis `kind` of `separate`."""
        from_ = a
        way = e - a
        other = c
        k = kind - 2
        m = R3()
        if kind == 1:
            normal = wp.cross(e - a, c - a)
            m = wp.normalize(normal) * wp.where(wp.dot(normal, a) < S(0.0), S(-1.0), S(1.0))
        else:
            if k >= 6:
                from_ = c
                way = a - c
                other = e
            elif k >= 3:
                from_ = e
                way = c - e
                other = a
            wide = R3(S(0.0), way[2], -way[1])
            if k % 3 == 1:
                wide = R3(-way[2], S(0.0), way[0])
            elif k % 3 == 2:
                wide = R3(way[1], -way[0], S(0.0))
            out = wp.where(wp.dot(wide, other - from_) < S(0.0), S(-1.0), S(1.0))
            m = wp.normalize(wide) * out
        return m, from_, way

    @wp.func
    def weights_and_point(kind: int, n: R3, from_: R3, way: R3, a: R3, e: R3, c: R3, h: R3):
        """Weights of the corners and the box's point, before the two slide beside each other."""
        near = R3(
            wp.where(n[0] < S(0.0), -h[0], h[0]),
            wp.where(n[1] < S(0.0), -h[1], h[1]),
            wp.where(n[2] < S(0.0), -h[2], h[2]),
        )
        u = R3()
        point = near
        if kind == 1:
            u = barycentric(near, a, e, c)
        else:
            k = kind - 2
            along = R3(S(1.0), S(0.0), S(0.0))
            if k % 3 == 1:
                along = R3(S(0.0), S(1.0), S(0.0))
            elif k % 3 == 2:
                along = R3(S(0.0), S(0.0), S(1.0))
            flat = way - along * wp.dot(way, along)
            s = wp.clamp(wp.dot(near - from_, flat) / wp.dot(flat, flat), S(0.0), S(1.0))
            if k >= 6:
                u = R3(s, S(0.0), S(1.0) - s)
            elif k >= 3:
                u = R3(S(0.0), S(1.0) - s, s)
            else:
                u = R3(S(1.0) - s, s, S(0.0))
            reach = wp.dot(h, along)
            at = wp.clamp(wp.dot(from_ + way * s, along), -reach, reach)
            point = near + along * (at - wp.dot(near, along))
        return u, point

    @wp.func
    def beside(a: R3, e: R3, c: R3, u: R3, h: R3):
        on = a * u[0] + e * u[1] + c * u[2]
        at = R3(
            wp.clamp(on[0], -h[0], h[0]), wp.clamp(on[1], -h[1], h[1]), wp.clamp(on[2], -h[2], h[2])
        )
        return on - at, at

    @wp.func
    def contact_loss(
        corners: Corners,
        body: BodyValue,
        box: BoxValue,
        mu: S,
        radius: S,
        max_recovery: S,
        kind: int,
        apart: int,
        yielding: R3,
        after: AfterContact,
    ) -> S:
        """The derivatives `after` the contact times what it leaves: `wp.grad` of this takes it
        back.
        """
        xa = raised(corners.a, radius)
        xb = raised(corners.b, radius)
        xc = raised(corners.c, radius)
        oa = corners.a_start
        ob = corners.b_start
        oc = corners.c_start
        wa = corners.wa
        wb = corners.wb
        wc = corners.wc
        x = body.x
        q = body.q
        xp = body.xp
        qp = body.qp
        w = body.w
        inverse = body.inverse_inertia
        center = box.center
        rotation = box.rotation
        h = box.half
        turn = q * rotation
        middle = x + wp.quat_rotate(q, center)
        a = wp.quat_rotate_inv(turn, xa - middle)
        e = wp.quat_rotate_inv(turn, xb - middle)
        c = wp.quat_rotate_inv(turn, xc - middle)
        m, from_, way = axis_of(kind, a, e, c)
        u, point = weights_and_point(kind, m, from_, way, a, e, c, h)
        off, at = beside(a, e, c, u, h)
        corner = R3(
            wp.where(m[0] < S(0.0), -h[0], h[0]),
            wp.where(m[1] < S(0.0), -h[1], h[1]),
            wp.where(m[2] < S(0.0), -h[2], h[2]),
        )
        gap = wp.dot(m, from_ - corner)
        n = m
        near = point
        if apart > 0:
            gap = wp.length(off)
            n = off / gap
            near = at
        local = center + wp.quat_rotate(rotation, near)
        r = wp.quat_rotate(q, local)
        out = wp.quat_rotate(turn, n)
        step = (xa - oa) * u[0] + (xb - ob) * u[1] + (xc - oc) * u[2]
        slid = step - (x + r - (xp + wp.quat_rotate(qp, local)))
        approach = wp.dot(slid, out)
        depth = correction(radius - gap, approach, max_recovery)
        response = response_of(w, inverse, q, r, out)
        ya = wa * yielding[0]
        yb = wb * yielding[1]
        yc = wc * yielding[2]
        total = ya * u[0] * u[0] + yb * u[1] * u[1] + yc * u[2] * u[2] + response
        across = wa * u[0] * u[0] + wb * u[1] * u[1] + wc * u[2] * u[2] + response
        slip = slid - out * approach
        budget = depth * mu * across / total
        along = out * (depth / total)
        drag = slip * (stick_share(wp.dot(slip, slip), budget) / across)
        push = along - drag
        ends = wp.dot(after.a, corners.a + push * (wa * u[0]))
        ends += wp.dot(after.b, corners.b + push * (wb * u[1]))
        ends += wp.dot(after.c, corners.c + push * (wc * u[2]))
        return ends + impulse_loss(x, q, w, inverse, r, -push, after.x, after.q)

    @wp.func
    def sweep_box_triangle(
        at: int,
        face: int,
        finished: int,
        lane: int,
        p0: int,
        radii: int,
        shape: int,
        b: int,
        mu: S,
        max_recovery: S,
        counts: int,
        top: Topology,
        shapes: Shapes,
        bodies: Bodies,
        sheets: Sheets,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        by_mu = S(0.0)
        tri = sheets.triangle[face]
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        xa = position(at, tape)
        xb = position(at + 3, tape)
        xc = position(at + 6, tape)
        body = taped_body(at + 9, b, bodies, tape)
        box = box_value(shape, shapes)
        h = box.half
        kind = counts + wp.static(int(Kind.BOX_TRIANGLE))
        count_one(kind, lane, adj)
        radius = top.radius[radii + tri[0]]
        # the branch that the forward pass took
        turn = body.q * box.rotation
        middle = body.x + wp.quat_rotate(body.q, box.center)
        za = raised(xa, radius)
        zb = raised(xb, radius)
        zc = raised(xc, radius)
        a = wp.quat_rotate_inv(turn, za - middle)
        e = wp.quat_rotate_inv(turn, zb - middle)
        c = wp.quat_rotate_inv(turn, zc - middle)
        gap, which, n = separate(a, e, c, h, radius)
        from_ = a
        way = e - a
        if which >= 8:
            from_ = c
            way = a - c
        elif which >= 5:
            from_ = e
            way = c - e
        near = corner_towards(h, n)
        u = R3()
        if which == 1:
            u = barycentric(near, a, e, c)
        else:
            flat = way
            k = (which - 2) % 3
            flat[k] = S(0.0)
            s = wp.clamp(wp.dot(near - from_, flat) / wp.dot(flat, flat), S(0.0), S(1.0))
            u = R3(S(1.0) - s, s, S(0.0))
            if which >= 8:
                u = R3(s, S(0.0), S(1.0) - s)
            elif which >= 5:
                u = R3(S(0.0), S(1.0) - s, s)
        apart = wp.where(gap > S(0.0), 1, 0)
        if apart > 0:
            on = a * u[0] + e * u[1] + c * u[2]
            n = on - wp.max(-h, wp.min(on, h))
            n = n / wp.max(wp.length(n), S(1.0e-8))
        down = wp.quat_rotate(turn, n)[2]
        wa = get_mass(adj.w_flat, ia, lane)
        wb = get_mass(adj.w_flat, ib, lane)
        wc = get_mass(adj.w_flat, ic, lane)
        yielding = R3(
            stands(za[2], radius, down),
            stands(zb[2], radius, down),
            stands(zc[2], radius, down),
        )
        given = wa * yielding[0] * u[0] + wb * yielding[1] * u[1] + wc * yielding[2] * u[2]
        if given + body.w > S(0.0):
            rub = shapes.friction[shape]
            corners = Corners()
            corners.a = xa
            corners.b = xb
            corners.c = xc
            corners.a_start = get(tape.x_flat, finished + 3 * tri[0] + 1, lane)
            corners.b_start = get(tape.x_flat, finished + 3 * tri[1] + 1, lane)
            corners.c_start = get(tape.x_flat, finished + 3 * tri[2] + 1, lane)
            corners.wa = wa
            corners.wb = wb
            corners.wc = wc
            after = AfterContact()
            after.a = get(adj.x_flat, ia, lane)
            after.b = get(adj.x_flat, ib, lane)
            after.c = get(adj.x_flat, ic, lane)
            after.x = ba.x[b]
            after.q = ba.q[b]
            g, g_body, _box, g_mu, g_radius, _recovery, _kind, _apart, _yielding, _after = wp.grad(
                contact_loss
            )(corners, body, box, mu * rub, radius, max_recovery, which, apart, yielding, after)
            put(adj.x_flat, ia, lane, g.a)
            put(adj.x_flat, ib, lane, g.b)
            put(adj.x_flat, ic, lane, g.c)
            put(adj.xp_flat, ia, lane, get(adj.xp_flat, ia, lane) + g.a_start)
            put(adj.xp_flat, ib, lane, get(adj.xp_flat, ib, lane) + g.b_start)
            put(adj.xp_flat, ic, lane, get(adj.xp_flat, ic, lane) + g.c_start)
            add_mass(ia, lane, wa, g.wa, adj)
            add_mass(ib, lane, wb, g.wb, adj)
            add_mass(ic, lane, wc, g.wc, adj)
            add_radius(ia, lane, g_radius, adj)
            add_to_body(b, body.w, g_body, ba)
            by_mu = g_mu * rub
        return by_mu

    return SimpleNamespace(
        record_box_triangles=record_box_triangles, sweep_box_triangle=sweep_box_triangle
    )
