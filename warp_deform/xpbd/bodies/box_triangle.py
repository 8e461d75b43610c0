"""Contact and friction between boxes and triangles, two-way: corners and edges that meet a fabric.

The axis that separates the two best among the 13 candidates (separating axis theorem: the box's
faces, the triangle's normal, edges across edges) is the contact normal. It points away from the
box's centre, so a box stays on that side of the fabric on which its centre is. Source: Ericson,
Real-Time Collision Detection, section 5.2.9.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.closest_point import closest_point
from ..contact.friction import friction
from ..contact.table_support import table_support
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from .box_particle import box_particle
from .overlap_recovery import overlap_recovery
from .rigid_body import rigid_body

__all__ = ["box_triangle"]


@functools.cache
def box_triangle(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_box_triangles(...)`: the triangles of one lane against one box.

    They are those that come within `wide` [m] of the box's centre.

    A face of the box is met by the triangle's corners, see `box_particle`, so only the triangle's
    normal (a corner of the box meets it) and edges across edges are solved here: with the radius of
    the fabric, and shared by the triangle's corners. Separation is limited as in
    `overlap_recovery`.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Shapes, Bodies, Topology = t.Shapes, t.Bodies, t.Topology
    Sheets, Cells = t.Sheets, t.Cells
    body = rigid_body(scalar, lanes)
    response, apply_impulse, moved = body.response, body.apply_impulse, body.moved
    coulomb_scalar = friction(scalar, lanes).coulomb_scalar
    access = lane_access(scalar, lanes)
    get, put, get_mass = access.get, access.put, access.get_mass
    barycentric = closest_point(scalar, lanes).barycentric
    stands = box_particle(scalar, lanes).stands
    raised = table_support(scalar, lanes).raised
    correction = overlap_recovery(scalar).correction
    # of an edge and a side of the box that are nearly parallel, the ends tell more
    PARALLEL = S(1.0e-3)
    # an axis of edges must win clearly: it would flicker where edges are nearly parallel
    AHEAD = S(1.0e-5)

    # Most triangles are far away. As a loop over indexed arrays, the search for the next one whose
    # bounding box meets the cube about m would cost more than what follows it.
    c_type = {wp.float32: "float", wp.float64: "double"}[scalar]

    @wp.func_native(f"""
        for (; f < end; ++f) {{
            const auto& t = triangle.data[f];
            const {c_type}* a = x.data + (size_t)(p0 + t[0]) * {3 * L} + lane;
            const {c_type}* b = x.data + (size_t)(p0 + t[1]) * {3 * L} + lane;
            const {c_type}* c = x.data + (size_t)(p0 + t[2]) * {3 * L} + lane;
            bool near = true;
            for (int k = 0; k < 3; ++k) {{
                const {c_type} low = m[k] - wide, high = m[k] + wide;
                const {c_type} p = a[{L} * k], q = b[{L} * k], r = c[{L} * k];
                near &= (p > low) | (q > low) | (r > low);
                near &= (p < high) | (q < high) | (r < high);
            }}
            if (near) break;
        }}
        return f;""")
    def next_near(
        triangle: wp.array(dtype=wp.vec3i),
        x: wp.array(dtype=S),
        f: int,
        end: int,
        p0: int,
        lane: int,
        m: R3,
        wide: S,
    ) -> int: ...

    @wp.func
    def corner_towards(h: R3, n: R3):
        """Corner of a box that is farthest along n."""
        return R3(
            wp.where(n[0] < S(0.0), -h[0], h[0]),
            wp.where(n[1] < S(0.0), -h[1], h[1]),
            wp.where(n[2] < S(0.0), -h[2], h[2]),
        )

    @wp.func
    def separate(a: R3, e: R3, c: R3, h: R3, radius: S):
        """Distance along the best axis (at least `radius`: apart), which it is, and the axis: 0 a
        face of the box, 1 the triangle's normal, 2 + 3 * edge + axis across both.
        """
        low = wp.min(a, wp.min(e, c)) - h
        high = -wp.max(a, wp.max(e, c)) - h
        gap = wp.max(low[0], wp.max(low[1], low[2]))
        gap = wp.max(gap, wp.max(high[0], wp.max(high[1], high[2])))
        kind = int(0)
        n = wp.cross(e - a, c - a)
        wide = wp.length(n)
        if gap < radius and wide > S(1.0e-12):
            n = n * (wp.where(wp.dot(n, a) < S(0.0), S(-1.0), S(1.0)) / wide)
            apart = wp.dot(n, a - corner_towards(h, n))
            if apart > gap:
                gap = apart
                kind = int(1)
        else:
            gap = radius
        if gap < radius:
            for k in range(9):
                from_ = a
                way = e - a
                other = c
                if k >= 6:
                    from_ = c
                    way = a - c
                    other = e
                elif k >= 3:
                    from_ = e
                    way = c - e
                    other = a
                axis = k % 3
                m = R3(S(0.0), way[2], -way[1])
                if axis == 1:
                    m = R3(-way[2], S(0.0), way[0])
                elif axis == 2:
                    m = R3(way[1], -way[0], S(0.0))
                wide = wp.length(m)
                if wide > PARALLEL * wp.length(way):
                    # outwards: the edge is what is nearest to the box along m
                    m = m * (wp.where(wp.dot(m, other - from_) < S(0.0), S(-1.0), S(1.0)) / wide)
                    apart = wp.dot(m, from_ - corner_towards(h, m))
                    if apart > gap + AHEAD:
                        gap = apart
                        kind = int(2) + k
                        n = m
        return gap, kind, n

    @wp.func
    def project_box_triangle(
        f: int,
        lane: int,
        p0: int,
        radii: int,
        shape: int,
        b: int,
        center: R3,
        mu: S,
        max_recovery: S,
        top: Topology,
        shapes: Shapes,
        bodies: Bodies,
        sheets: Sheets,
        cells: Cells,
    ):
        """Returns whether the two met, which may have moved the box."""
        met = bool(False)
        tri = sheets.triangle[f]
        radius = top.radius[radii + tri[0]]
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        xa = get(cells.x, ia, lane)
        xb = get(cells.x, ib, lane)
        xc = get(cells.x, ic, lane)
        za = raised(xa, radius)
        zb = raised(xb, radius)
        zc = raised(xc, radius)
        # in the box's own frame
        h = shapes.half[shape]
        turn = bodies.q[b] * shapes.rotation[shape]
        a = wp.quat_rotate_inv(turn, za - center)
        e = wp.quat_rotate_inv(turn, zb - center)
        c = wp.quat_rotate_inv(turn, zc - center)
        gap, kind, n = separate(a, e, c, h, radius)
        if gap < radius and kind > 0:
            u = R3()
            near = corner_towards(h, n)
            if kind == 1:
                u = barycentric(near, a, e, c)
            else:
                k = kind - 2
                axis = k % 3
                from_ = a
                way = e - a
                if k >= 6:
                    from_ = c
                    way = a - c
                elif k >= 3:
                    from_ = e
                    way = c - e
                d = near - from_
                d[axis] = S(0.0)
                flat = way
                flat[axis] = S(0.0)
                s = wp.clamp(wp.dot(d, flat) / wp.dot(flat, flat), S(0.0), S(1.0))
                if k >= 6:
                    u = R3(s, S(0.0), S(1.0) - s)
                elif k >= 3:
                    u = R3(S(0.0), S(1.0) - s, s)
                else:
                    u = R3(S(1.0) - s, s, S(0.0))
                near[axis] = wp.clamp(from_[axis] + way[axis] * s, -h[axis], h[axis])
            if gap > S(0.0):
                # beside each other, they are farther apart than along any axis
                n = a * u[0] + e * u[1] + c * u[2]
                near = wp.max(-h, wp.min(n, h))
                n = n - near
                gap = wp.length(n)
                n = n / wp.max(gap, S(1.0e-8))
            if gap < radius:
                local = shapes.center[shape] + wp.quat_rotate(shapes.rotation[shape], near)
                r = wp.quat_rotate(bodies.q[b], local)
                n = wp.quat_rotate(turn, n)
                step = (za - get(cells.xp, ia, lane)) * u[0] - moved(b, bodies, local)
                step += (zb - get(cells.xp, ib, lane)) * u[1]
                step += (zc - get(cells.xp, ic, lane)) * u[2]
                approach = wp.dot(step, n)
                depth = correction(radius - gap, approach, max_recovery)
                wa = get_mass(cells.w, ia, lane)
                wb = get_mass(cells.w, ib, lane)
                wc = get_mass(cells.w, ic, lane)
                # corners that the table carries do not give way downwards, but pass the load on,
                # see `box_particle`
                ya = wa * stands(za[2], radius, n[2])
                yb = wb * stands(zb[2], radius, n[2])
                yc = wc * stands(zc[2], radius, n[2])
                w = ya * u[0] * u[0] + yb * u[1] * u[1] + yc * u[2] * u[2]
                w += response(b, bodies, r, n)
                across = wa * u[0] * u[0] + wb * u[1] * u[1] + wc * u[2] * u[2]
                across += response(b, bodies, r, n)
                if w > S(0.0):
                    slip = step - n * approach
                    budget = depth * mu * shapes.friction[shape] * across / w
                    along = n * (depth / w)
                    drag = slip * (coulomb_scalar(wp.dot(slip, slip), budget) / across)
                    push = along - drag
                    put(cells.x, ia, lane, xa + push * (wa * u[0]))
                    put(cells.x, ib, lane, xb + push * (wb * u[1]))
                    put(cells.x, ic, lane, xc + push * (wc * u[2]))
                    apply_impulse(b, bodies, r, -push)
                bodies.touching[b] = bodies.touching[b] + 1
                bodies.support[b] = bodies.support[b] + 1
                met = True
        return met

    @wp.func
    def project_box_triangles(
        lane: int,
        k: int,
        p0: int,
        radii: int,
        shape: int,
        b: int,
        wide: S,
        mu: S,
        max_recovery: S,
        top: Topology,
        shapes: Shapes,
        bodies: Bodies,
        sheets: Sheets,
        cells: Cells,
    ):
        center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
        end = sheets.first[k + 1]
        f = next_near(sheets.triangle, cells.x, sheets.first[k], end, p0, lane, center, wide)
        while f < end:
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
            f = next_near(sheets.triangle, cells.x, f + 1, end, p0, lane, center, wide)

    return SimpleNamespace(
        project_box_triangles=project_box_triangles,
        project_box_triangle=project_box_triangle,
        separate=separate,
        corner_towards=corner_towards,
        next_near=next_near,
    )
