"""Contact and friction between boxes.

The axis of least overlap among the 15 candidates of two boxes (separating axis theorem) is the
contact normal. For a face axis, the edges of the other box's facing side are clipped against that
face: the ends of every clipped edge are contact points, which covers corners on a face as well as
boxes that lie across each other. For an edge axis the contact is the two edges' closest points.
Source: Ericson, Real-Time Collision Detection, sections 4.4 and 5.5.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .friction import friction
from .rigid import rigid
from .structures import structures

__all__ = ["box_box"]


@functools.cache
def box_box(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_boxes(sa, a, sb, b, ...)`: shape sa of body a against shape sb of body b."""
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Shapes, Bodies = t.Shapes, t.Bodies
    body = rigid(scalar, lanes)
    response, push_body, moved = body.response, body.push_body, body.moved
    coulomb_scalar = friction(scalar, lanes).coulomb_scalar

    @wp.func
    def column(m: M33, k: int):
        return R3(m[0, k], m[1, k], m[2, k])

    @wp.func
    def reach(axes: M33, half: R3, n: R3):
        """Half width of a box along n."""
        return (
            wp.abs(wp.dot(column(axes, 0), n)) * half[0]
            + wp.abs(wp.dot(column(axes, 1), n)) * half[1]
            + wp.abs(wp.dot(column(axes, 2), n)) * half[2]
        )

    @wp.func
    def contact(a: int, b: int, pa: R3, pb: R3, n: R3, mu: S, push: S, bodies: Bodies):
        """Separate point pa of body a from point pb of body b along n (from a to b)."""
        depth = wp.dot(pa - pb, n)
        if depth > S(0.0):
            ra = pa - bodies.x[a]
            rb = pb - bodies.x[b]
            step = moved(b, bodies, wp.quat_rotate_inv(bodies.q[b], rb)) - moved(
                a, bodies, wp.quat_rotate_inv(bodies.q[a], ra)
            )
            approach = wp.dot(step, n)
            depth = wp.min(depth, wp.max(-approach, S(0.0)) + push)
            w = response(a, bodies, ra, n) + response(b, bodies, rb, n)
            if w > S(0.0):
                slip = step - n * approach
                f = coulomb_scalar(wp.dot(slip, slip), depth * mu)
                impulse = (n * depth - slip * f) / w
                push_body(b, bodies, rb, impulse)
                push_body(a, bodies, ra, -impulse)
                bodies.touching[a] = bodies.touching[a] + 1
                bodies.touching[b] = bodies.touching[b] + 1

    @wp.func
    def clip(a: int, b: int, axis: int, flip: S, ca: R3, aa: M33, ha: R3, cb: R3, ab: M33, hb: R3,
             swap: int, mu: S, push: S, bodies: Bodies):  # fmt: skip
        """Contacts of box b's side that faces the face `axis` of box a; flip: which of the two."""
        n = column(aa, axis) * flip
        u = column(aa, (axis + 1) % 3)
        v = column(aa, (axis + 2) % 3)
        hu = ha[(axis + 1) % 3]
        hv = ha[(axis + 2) % 3]
        # side of b most opposed to n
        k = int(0)
        best = S(0.0)
        for e in range(3):
            c = wp.abs(wp.dot(column(ab, e), n))
            if c > best:
                best = c
                k = e
        side = column(ab, k) * (-wp.sign(wp.dot(column(ab, k), n)) * hb[k])
        eu = column(ab, (k + 1) % 3) * hb[(k + 1) % 3]
        ev = column(ab, (k + 2) % 3) * hb[(k + 2) % 3]
        face = wp.dot(ca, n) + ha[axis]
        for edge in range(4):
            s0 = S(1.0)
            if edge == 1 or edge == 2:
                s0 = S(-1.0)
            s1 = S(1.0)
            if edge >= 2:
                s1 = S(-1.0)
            # corners in order around the side
            p = cb + side + eu * s0 + ev * s1
            d = eu * (S(-2.0) * s0)
            if edge == 1 or edge == 3:
                d = ev * (S(-2.0) * s1)
            lo = S(0.0)
            hi = S(1.0)
            pu = wp.dot(p - ca, u)
            pv = wp.dot(p - ca, v)
            du = wp.dot(d, u)
            dv = wp.dot(d, v)
            if wp.abs(du) > S(1.0e-9):
                lo = wp.max(lo, wp.min((-hu - pu) / du, (hu - pu) / du))
                hi = wp.min(hi, wp.max((-hu - pu) / du, (hu - pu) / du))
            elif wp.abs(pu) > hu:
                hi = S(-1.0)
            if wp.abs(dv) > S(1.0e-9):
                lo = wp.max(lo, wp.min((-hv - pv) / dv, (hv - pv) / dv))
                hi = wp.min(hi, wp.max((-hv - pv) / dv, (hv - pv) / dv))
            elif wp.abs(pv) > hv:
                hi = S(-1.0)
            if lo <= hi:
                for end in range(2):
                    at = p + d * lo
                    if end == 1:
                        at = p + d * hi
                    gap = wp.dot(at, n) - face
                    if gap < S(0.0):
                        if swap == 0:
                            contact(a, b, at - n * gap, at, n, mu, push, bodies)
                        else:
                            contact(b, a, at, at - n * gap, -n, mu, push, bodies)

    @wp.func
    def project_boxes(
        sa: int, a: int, sb: int, b: int, mu: S, push: S, shapes: Shapes, bodies: Bodies
    ):
        ha = shapes.half[sa]
        hb = shapes.half[sb]
        ca = bodies.x[a] + wp.quat_rotate(bodies.q[a], shapes.center[sa])
        cb = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[sb])
        d = cb - ca
        if wp.dot(d, d) < (wp.length(ha) + wp.length(hb)) * (wp.length(ha) + wp.length(hb)):
            aa = wp.quat_to_matrix(bodies.q[a] * shapes.rotation[sa])
            ab = wp.quat_to_matrix(bodies.q[b] * shapes.rotation[sb])
            least = S(1.0e9)
            kind = int(-1)
            normal = R3()
            for k in range(15):
                n = R3()
                # edge axes must win clearly: near-parallel edges would otherwise flicker
                bias = S(1.0)
                if k < 3:
                    n = column(aa, k)
                elif k < 6:
                    n = column(ab, k - 3)
                else:
                    n = wp.cross(column(aa, (k - 6) // 3), column(ab, (k - 6) % 3))
                    bias = S(1.05)
                l = wp.length(n)
                if l > S(1.0e-3) and least > S(0.0):
                    n = n / l
                    overlap = reach(aa, ha, n) + reach(ab, hb, n) - wp.abs(wp.dot(d, n))
                    if overlap <= S(0.0):
                        least = S(-1.0)
                    elif overlap * bias < least:
                        least = overlap * bias
                        kind = k
                        normal = n * wp.where(wp.dot(d, n) < S(0.0), S(-1.0), S(1.0))
            if least > S(0.0) and kind >= 0:
                if kind < 3:
                    flip = wp.where(wp.dot(column(aa, kind), normal) < S(0.0), S(-1.0), S(1.0))
                    clip(a, b, kind, flip, ca, aa, ha, cb, ab, hb, 0, mu, push, bodies)
                elif kind < 6:
                    flip = wp.where(wp.dot(column(ab, kind - 3), normal) < S(0.0), S(1.0), S(-1.0))
                    clip(b, a, kind - 3, flip, cb, ab, hb, ca, aa, ha, 1, mu, push, bodies)
                else:
                    ea = (kind - 6) // 3
                    eb = (kind - 6) % 3
                    pa = ca
                    pb = cb
                    for k in range(3):
                        if k != ea:
                            pa += column(aa, k) * (wp.sign(wp.dot(column(aa, k), normal)) * ha[k])
                        if k != eb:
                            pb -= column(ab, k) * (wp.sign(wp.dot(column(ab, k), normal)) * hb[k])
                    u = column(aa, ea)
                    v = column(ab, eb)
                    uv = wp.dot(u, v)
                    w = pb - pa
                    bottom = S(1.0) - uv * uv
                    su = (wp.dot(w, u) - uv * wp.dot(w, v)) / bottom
                    sv = (uv * wp.dot(w, u) - wp.dot(w, v)) / bottom
                    contact(a, b, pa + u * su, pb + v * sv, normal, mu, push, bodies)

    return SimpleNamespace(project_boxes=project_boxes, Q=Q)
