"""Contact and friction between boxes and triangles, two-way: corners that poke a fabric."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .closest_point import closest_point
from .friction import friction
from .lane_access import lane_access
from .rigid import rigid
from .structures import structures

__all__ = ["box_triangle"]

ROUNDS = 4
"""Alternating projections for the nearest points; each starts where the one before ended."""


@functools.cache
def box_triangle(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_box_triangle`: one triangle of one lane against one box.

    The nearest points of two convex sets are found by projecting onto one and the other by turns
    (Cheney, Goldstein, 1959). The triangle's point then meets the box as a particle does, see
    `box_particle`: with the radius of the fabric, and shared by the triangle's corners.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Shapes, Bodies, Sheets, Cells = t.Shapes, t.Bodies, t.Sheets, t.Cells
    body = rigid(scalar, lanes)
    response, push_body, moved = body.response, body.push_body, body.moved
    coulomb_scalar = friction(scalar, lanes).coulomb_scalar
    access = lane_access(scalar, lanes)
    get, put, get_mass = access.get, access.put, access.get_mass
    barycentric = closest_point(scalar, lanes).barycentric

    @wp.func
    def project_box_triangle(
        f: int, lane: int, p0: int, radius: S, shape: int, b: int, mu: S, push: S,
        shapes: Shapes, bodies: Bodies, sheets: Sheets, cells: Cells,
    ):  # fmt: skip
        tri = sheets.triangle[f]
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        xa = get(cells.x, ia, lane)
        xb = get(cells.x, ib, lane)
        xc = get(cells.x, ic, lane)
        h = shapes.half[shape]
        center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
        # a sphere about each, before anything dear
        middle = (xa + xb + xc) / S(3.0)
        wide = wp.length(h) + radius
        reach = wp.sqrt(
            wp.max(
                wp.length_sq(xa - middle),
                wp.max(wp.length_sq(xb - middle), wp.length_sq(xc - middle)),
            )
        )
        if wp.length_sq(middle - center) < (wide + reach) * (wide + reach):
            # in the box's own frame
            turn = bodies.q[b] * shapes.rotation[shape]
            a = wp.quat_rotate_inv(turn, xa - center)
            e = wp.quat_rotate_inv(turn, xb - center)
            c = wp.quat_rotate_inv(turn, xc - center)
            near = R3()
            u = R3()
            at = R3()
            for _ in range(ROUNDS):
                u = barycentric(near, a, e, c)
                at = a * u[0] + e * u[1] + c * u[2]
                near = wp.max(-h, wp.min(at, h))
            n = at - near
            gap = wp.length(n)
            if gap < radius:
                if gap > S(1.0e-8):
                    n = n / gap
                else:
                    ox = wp.abs(at[0]) - h[0]
                    oy = wp.abs(at[1]) - h[1]
                    oz = wp.abs(at[2]) - h[2]
                    gap = wp.max(ox, wp.max(oy, oz))
                    if ox >= oy and ox >= oz:
                        n = R3(wp.sign(at[0]), S(0.0), S(0.0))
                    elif oy >= oz:
                        n = R3(S(0.0), wp.sign(at[1]), S(0.0))
                    else:
                        n = R3(S(0.0), S(0.0), wp.sign(at[2]))
                local = shapes.center[shape] + wp.quat_rotate(shapes.rotation[shape], near)
                r = wp.quat_rotate(bodies.q[b], local)
                n = wp.quat_rotate(turn, n)
                step = (xa - get(cells.xp, ia, lane)) * u[0] - moved(b, bodies, local)
                step += (xb - get(cells.xp, ib, lane)) * u[1]
                step += (xc - get(cells.xp, ic, lane)) * u[2]
                approach = wp.dot(step, n)
                depth = wp.min(radius - gap, wp.max(push - approach, S(0.0)))
                wa = get_mass(cells.w, ia, lane) * u[0]
                wb = get_mass(cells.w, ib, lane) * u[1]
                wc = get_mass(cells.w, ic, lane) * u[2]
                w = wa * u[0] + wb * u[1] + wc * u[2] + response(b, bodies, r, n)
                if w > S(0.0):
                    slip = step - n * approach
                    budget = depth * mu * shapes.friction[shape]
                    share = coulomb_scalar(wp.dot(slip, slip), budget)
                    impulse = (n * depth - slip * share) / w
                    put(cells.x, ia, lane, xa + impulse * wa)
                    put(cells.x, ib, lane, xb + impulse * wb)
                    put(cells.x, ic, lane, xc + impulse * wc)
                    push_body(b, bodies, r, -impulse)
                    bodies.touching[b] = bodies.touching[b] + 1
                    bodies.support[b] = bodies.support[b] + 1

    return SimpleNamespace(project_box_triangle=project_box_triangle)
