"""Adjoint of contact between boxes and triangles, see `box_triangle`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.closest_point import closest_point
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import BODY_WORDS, BOX_TRIANGLE_SCALARS, Kind
from .box_particle import box_particle
from .box_particle_adjoint import box_particle_adjoint
from .box_triangle import box_triangle
from .rigid_body_adjoint import rigid_adjoint

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
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Shapes, Bodies, Topology = t.Shapes, t.Bodies, t.Topology
    Sheets, Cells, Tape = t.Sheets, t.Cells, t.Tape
    Adjoint, BodyAdjoint = t.Adjoint, t.BodyAdjoint
    access = lane_access(scalar, lanes)
    count_one = access.count_one
    get, put, get_mass = access.get, access.put, access.get_mass
    barycentric = closest_point(scalar, lanes).barycentric
    stands = box_particle(scalar, lanes).stands
    solve = box_triangle(scalar, lanes)
    separate, corner_towards = solve.separate, solve.corner_towards
    project_box_triangle, next_near = solve.project_box_triangle, solve.next_near
    particle_ = box_particle_adjoint(scalar, lanes)
    stick_share, resists, pushed = particle_.stick_share, particle_.resists, particle_.pushed
    add_to_body, add_mass = particle_.add_to_body, particle_.add_mass
    poses = rigid_adjoint(scalar, lanes)
    push_pose, position, quaternion = poses.push_pose, poses.position, poses.quaternion

    @wp.func
    def record_box_triangles(
        word: int, at: int, lane: int, k: int, p0: int, radii: int, shape: int, number: int, b: int,
        wide: S, mu: S, push: S, top: Topology, shapes: Shapes, bodies: Bodies, sheets: Sheets,
        cells: Cells, tape: Tape,
    ):  # fmt: skip
        found = int(0)
        center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
        end = sheets.first[k + 1]
        f = next_near(sheets.triangle, cells.x, sheets.first[k], end, p0, lane, center, wide)
        while f < end:
            tri = sheets.triangle[f]
            # what does not meet the box is overwritten by the next one
            s = at + found * wp.static(BOX_TRIANGLE_SCALARS)
            for corner in range(3):
                x = get(cells.x, p0 + tri[corner], lane)
                for axis in range(3):
                    tape.s[s + 3 * corner + axis] = x[axis]
            push_pose(s + 9, bodies.x[b], bodies.q[b], tape)
            if project_box_triangle(
                f, lane, p0, radii, shape, b, center, mu, push, top, shapes, bodies, sheets, cells
            ):
                center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
                tape.k[word + found * wp.static(BODY_WORDS)] = -1 - f
                tape.k[word + found * wp.static(BODY_WORDS) + 1] = number
                found += 1
            f = next_near(sheets.triangle, cells.x, f + 1, end, p0, lane, center, wide)
        return found

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
            wp.where(n[0] < S(0.0), -h[0], h[0]), wp.where(n[1] < S(0.0), -h[1], h[1]),
            wp.where(n[2] < S(0.0), -h[2], h[2]),
        )  # fmt: skip
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
    def met(
        xa: R3, xb: R3, xc: R3, oa: R3, ob: R3, oc: R3, wa: S, wb: S, wc: S, x: R3, q: Q, xp: R3,
        qp: Q, w: S, mu: S, inverse: M33, center: R3, rotation: Q, h: R3, radius: S, push: S,
        kind: int, apart: int, yielding: R3, ga: R3, gb: R3, gc: R3, gx: R3, gq: Q,
    ) -> S:  # fmt: skip
        turn = q * rotation
        middle = x + wp.quat_rotate(q, center)
        a = wp.quat_rotate_inv(turn, xa - middle)
        e = wp.quat_rotate_inv(turn, xb - middle)
        c = wp.quat_rotate_inv(turn, xc - middle)
        m, from_, way = axis_of(kind, a, e, c)
        u, point = weights_and_point(kind, m, from_, way, a, e, c, h)
        off, at = beside(a, e, c, u, h)
        corner = R3(
            wp.where(m[0] < S(0.0), -h[0], h[0]), wp.where(m[1] < S(0.0), -h[1], h[1]),
            wp.where(m[2] < S(0.0), -h[2], h[2]),
        )  # fmt: skip
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
        depth = wp.min(radius - gap, wp.max(push - approach, S(0.0)))
        body = resists(w, inverse, q, r, out)
        ya = wa * yielding[0]
        yb = wb * yielding[1]
        yc = wc * yielding[2]
        total = ya * u[0] * u[0] + yb * u[1] * u[1] + yc * u[2] * u[2] + body
        across = wa * u[0] * u[0] + wb * u[1] * u[1] + wc * u[2] * u[2] + body
        slip = slid - out * approach
        budget = depth * mu * across / total
        along = out * (depth / total)
        drag = slip * (stick_share(wp.dot(slip, slip), budget) / across)
        ends = wp.dot(ga, xa + (along * ya - drag * wa) * u[0])
        ends += wp.dot(gb, xb + (along * yb - drag * wb) * u[1])
        ends += wp.dot(gc, xc + (along * yc - drag * wc) * u[2])
        return ends + pushed(x, q, w, inverse, r, drag - along, gx, gq)

    @wp.func
    def sweep_box_triangle(
        at: int, face: int, finished: int, lane: int, p0: int, radii: int, shape: int, b: int,
        mu: S, push: S, counts: int, top: Topology, shapes: Shapes, bodies: Bodies, sheets: Sheets,
        tape: Tape, ba: BodyAdjoint, adj: Adjoint,
    ):  # fmt: skip
        by_mu = S(0.0)
        tri = sheets.triangle[face]
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        xa = position(at, tape)
        xb = position(at + 3, tape)
        xc = position(at + 6, tape)
        x = position(at + 9, tape)
        q = quaternion(at + 12, tape)
        kind = counts + wp.static(int(Kind.BOX_TRIANGLE))
        count_one(kind, lane, adj)
        inverse = M33()
        if bodies.w[b] > S(0.0):
            inverse = bodies.inverse_inertia[b]
        center = shapes.center[shape]
        rotation = shapes.rotation[shape]
        h = shapes.half[shape]
        radius = top.radius[radii + tri[0]]
        # the branch that the forward pass took
        turn = q * rotation
        middle = x + wp.quat_rotate(q, center)
        a = wp.quat_rotate_inv(turn, xa - middle)
        e = wp.quat_rotate_inv(turn, xb - middle)
        c = wp.quat_rotate_inv(turn, xc - middle)
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
            stands(xa[2], top.radius[radii + tri[0]], down),
            stands(xb[2], top.radius[radii + tri[1]], down),
            stands(xc[2], top.radius[radii + tri[2]], down),
        )
        given = wa * yielding[0] * u[0] + wb * yielding[1] * u[1] + wc * yielding[2] * u[2]
        if given + bodies.w[b] > S(0.0):
            rub = shapes.friction[shape]
            (
                ga, gb, gc, goa, gob, goc, gwa, gwb, gwc, gx, gq, gxp, gqp, gw, g_mu, _i, _c, _r,
                _h, _ra, _pu, _k, _ap, _y, _ga, _gb, _gc, _gx, _gq,
            ) = wp.grad(met)(
                xa, xb, xc, get(tape.x_flat, finished + 3 * tri[0] + 1, lane),
                get(tape.x_flat, finished + 3 * tri[1] + 1, lane),
                get(tape.x_flat, finished + 3 * tri[2] + 1, lane), wa, wb, wc, x, q, bodies.xp[b],
                bodies.qp[b], bodies.w[b], mu * rub, inverse, center, rotation, h, radius, push,
                which, apart, yielding, get(adj.x_flat, ia, lane), get(adj.x_flat, ib, lane),
                get(adj.x_flat, ic, lane), ba.x[b], ba.q[b],
            )  # fmt: skip
            put(adj.x_flat, ia, lane, ga)
            put(adj.x_flat, ib, lane, gb)
            put(adj.x_flat, ic, lane, gc)
            put(adj.xp_flat, ia, lane, get(adj.xp_flat, ia, lane) + goa)
            put(adj.xp_flat, ib, lane, get(adj.xp_flat, ib, lane) + gob)
            put(adj.xp_flat, ic, lane, get(adj.xp_flat, ic, lane) + goc)
            add_mass(ia, lane, wa, gwa, adj)
            add_mass(ib, lane, wb, gwb, adj)
            add_mass(ic, lane, wc, gwc, adj)
            add_to_body(b, bodies.w[b], gx, gq, gxp, gqp, gw, ba)
            by_mu = g_mu * rub
        return by_mu

    return SimpleNamespace(
        record_box_triangles=record_box_triangles, sweep_box_triangle=sweep_box_triangle
    )
