"""Adjoint of where boxes touch each other: how points and normals move with them, see `box_box`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .box_box import FLUSH

__all__ = ["box_box_adjoint"]


@functools.cache
def box_box_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_boxes` gives the derivatives by both points of a contact and its normal to the poses.

    Branches, all noted with the contact: the axis; which edge of the one box is cut off where, or
    which corner of the other box's face it is.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Shapes, Bodies, BodyAdjoint = t.Shapes, t.Bodies, t.BodyAdjoint

    @wp.func
    def column(m: M33, k: int):
        return R3(m[0, k], m[1, k], m[2, k])

    @wp.struct
    class Box:
        """Pose of a body, and one of its boxes."""

        x: R3
        q: Q
        center: R3
        rotation: Q
        half: R3

    @wp.func
    def box_of(b: int, shape: int, shapes: Shapes, bodies: Bodies):
        box = Box()
        box.x = bodies.x[b]
        box.q = bodies.q[b]
        box.center = shapes.center[shape]
        box.rotation = shapes.rotation[shape]
        box.half = shapes.half[shape]
        return box

    @wp.func
    def points(a: Box, b: Box, how: int, axis: int, k: int):
        """Point of a, point of b, normal."""
        qa = a.q
        qb = b.q
        ha = a.half
        hb = b.half
        ca = a.x + wp.quat_rotate(qa, a.center)
        cb = b.x + wp.quat_rotate(qb, b.center)
        aa = wp.quat_to_matrix(qa * a.rotation)
        ab = wp.quat_to_matrix(qb * b.rotation)
        n = R3()
        pa = R3()
        pb = R3()
        if how == 16:
            ua = column(aa, axis)
            ub = column(ab, k)
            nu = wp.normalize(wp.cross(ua, ub))
            n = nu * wp.where(wp.dot(cb - ca, nu) < S(0.0), S(-1.0), S(1.0))
            a0 = wp.sign(wp.dot(column(aa, 0), n)) * ha[0] * wp.where(axis == 0, S(0.0), S(1.0))
            a1 = wp.sign(wp.dot(column(aa, 1), n)) * ha[1] * wp.where(axis == 1, S(0.0), S(1.0))
            a2 = wp.sign(wp.dot(column(aa, 2), n)) * ha[2] * wp.where(axis == 2, S(0.0), S(1.0))
            b0 = wp.sign(wp.dot(column(ab, 0), n)) * hb[0] * wp.where(k == 0, S(0.0), S(1.0))
            b1 = wp.sign(wp.dot(column(ab, 1), n)) * hb[1] * wp.where(k == 1, S(0.0), S(1.0))
            b2 = wp.sign(wp.dot(column(ab, 2), n)) * hb[2] * wp.where(k == 2, S(0.0), S(1.0))
            ea = ca + column(aa, 0) * a0 + column(aa, 1) * a1 + column(aa, 2) * a2
            eb = cb - column(ab, 0) * b0 - column(ab, 1) * b1 - column(ab, 2) * b2
            uv = wp.dot(ua, ub)
            w = eb - ea
            bottom = S(1.0) - uv * uv
            pa = ea + ua * ((wp.dot(w, ua) - uv * wp.dot(w, ub)) / bottom)
            pb = eb + ub * ((uv * wp.dot(w, ua) - wp.dot(w, ub)) / bottom)
        else:
            face_axis = wp.normalize(column(aa, axis))
            n = face_axis * wp.where(wp.dot(cb - ca, face_axis) < S(0.0), S(-1.0), S(1.0))
            u = column(aa, (axis + 1) % 3)
            v = column(aa, (axis + 2) % 3)
            hu = ha[(axis + 1) % 3]
            hv = ha[(axis + 2) % 3]
            m = column(ab, k) * wp.sign(wp.dot(column(ab, k), n))
            eu = column(ab, (k + 1) % 3) * hb[(k + 1) % 3]
            ev = column(ab, (k + 2) % 3) * hb[(k + 2) % 3]
            side = cb - m * hb[k]
            edge = how // 4
            end = how % 4
            s0 = wp.where(edge == 1 or edge == 2, S(-1.0), S(1.0))
            s1 = wp.where(edge >= 2, S(-1.0), S(1.0))
            if end == 2:
                pa = ca + n * ha[axis] + u * (hu * s0) + v * (hv * s1)
                pb = pa + n * (wp.dot(side - pa, m) / wp.dot(m, n))
            else:
                p = side + eu * s0 + ev * s1
                d = eu * (S(-2.0) * s0 * wp.where(edge % 2 == 0, S(1.0), S(0.0))) + ev * (
                    S(-2.0) * s1 * wp.where(edge % 2 == 0, S(0.0), S(1.0))
                )
                pu = wp.dot(p - ca, u)
                pv = wp.dot(p - ca, v)
                du = wp.dot(d, u)
                dv = wp.dot(d, v)
                lo_u = S(0.0)
                hi_u = S(1.0)
                wu = hu + S(FLUSH)
                wv = hv + S(FLUSH)
                if wp.abs(du) > S(1.0e-9):
                    lo_u = wp.max(S(0.0), wp.min((-wu - pu) / du, (wu - pu) / du))
                    hi_u = wp.min(S(1.0), wp.max((-wu - pu) / du, (wu - pu) / du))
                lo = lo_u
                hi = hi_u
                if wp.abs(dv) > S(1.0e-9):
                    lo = wp.max(lo_u, wp.min((-wv - pv) / dv, (wv - pv) / dv))
                    hi = wp.min(hi_u, wp.max((-wv - pv) / dv, (wv - pv) / dv))
                pb = p + d * wp.where(end == 0, lo, hi)
                pa = pb - n * (wp.dot(pb, n) - wp.dot(ca, n) - ha[axis])
        return pa, pb, n

    @wp.func
    def points_loss(a: Box, b: Box, how: int, axis: int, k: int, ga: R3, gb: R3, gn: R3) -> S:
        """The derivatives ga, gb, gn by both points and the normal times these."""
        pa, pb, n = points(a, b, how, axis, k)
        return wp.dot(ga, pa) + wp.dot(gb, pb) + wp.dot(gn, n)

    @wp.func
    def sweep_boxes(
        a: int,
        b: int,
        code: wp.vec4i,
        ga: R3,
        gb: R3,
        gn: R3,
        shapes: Shapes,
        bodies: Bodies,
        ba: BodyAdjoint,
    ):
        by_a, by_b, _how, _axis, _k, _ga, _gb, _gn = wp.grad(points_loss)(
            box_of(a, code[0], shapes, bodies),
            box_of(b, code[1], shapes, bodies),
            code[2],
            code[3] // 4,
            code[3] % 4,
            ga,
            gb,
            gn,
        )
        ba.x[a] = ba.x[a] + by_a.x
        ba.q[a] = ba.q[a] + by_a.q
        ba.x[b] = ba.x[b] + by_b.x
        ba.q[b] = ba.q[b] + by_b.q

    return SimpleNamespace(sweep_boxes=sweep_boxes)
