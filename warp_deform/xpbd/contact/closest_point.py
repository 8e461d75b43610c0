"""The point of a triangle that is nearest to a given point."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures

__all__ = ["closest_point", "closest_point_adjoint"]


@functools.cache
def closest_point(scalar: Any, lanes: int) -> SimpleNamespace:
    """`barycentric(p, a, b, c)`: weights (R3) of the corners a, b, c for the nearest point to p.

    Source: Ericson, "Real-Time Collision Detection", 2005, section 5.1.5. The weights are not
    negative and add up to 1; all three are positive only where the nearest point is inside.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3

    @wp.func
    def barycentric(p: R3, a: R3, b: R3, c: R3):
        ab = b - a
        ac = c - a
        zero = S(0.0)
        one = S(1.0)
        d1 = wp.dot(ab, p - a)
        d2 = wp.dot(ac, p - a)
        if d1 <= zero and d2 <= zero:
            return R3(one, zero, zero)
        d3 = wp.dot(ab, p - b)
        d4 = wp.dot(ac, p - b)
        if d3 >= zero and d4 <= d3:
            return R3(zero, one, zero)
        vc = d1 * d4 - d3 * d2
        if vc <= zero and d1 >= zero and d3 <= zero:
            v = d1 / (d1 - d3)
            return R3(one - v, v, zero)
        d5 = wp.dot(ab, p - c)
        d6 = wp.dot(ac, p - c)
        if d6 >= zero and d5 <= d6:
            return R3(zero, zero, one)
        vb = d5 * d2 - d1 * d6
        if vb <= zero and d2 >= zero and d6 <= zero:
            w = d2 / (d2 - d6)
            return R3(one - w, zero, w)
        va = d3 * d6 - d5 * d4
        if va <= zero and d4 - d3 >= zero and d5 - d6 >= zero:
            w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            return R3(zero, one - w, w)
        k = one / (va + vb + vc)
        return R3(va * k, vb * k, vc * k)

    return SimpleNamespace(barycentric=barycentric)


@functools.cache
def closest_point_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`along_two(d, s, e, f, g)`: derivatives by r, e and f, rows of a matrix, from those g by the
    shares s at which |r - s[0] e - s[1] f| is least; d is the remainder there.

    `sweep_barycentric(u, g, d, ...)` does so for `barycentric`: whichever of inside, an edge or a
    corner is nearest stays so. Returns the derivatives by p, a, b, c.
    """
    t = structures(scalar, lanes)
    S, R3, M33 = t.S, t.R3, t.M33
    R2 = wp.types.vector(2, S)

    @wp.func
    def rows(r: R3, e: R3, f: R3):
        return M33(r[0], r[1], r[2], e[0], e[1], e[2], f[0], f[1], f[2])

    @wp.func
    def along_two(d: R3, s: R2, e: R3, f: R3, g: R2):
        ee = wp.dot(e, e)
        ff = wp.dot(f, f)
        ef = wp.dot(e, f)
        below = ee * ff - ef * ef
        y0 = (ff * g[0] - ef * g[1]) / below
        y1 = (ee * g[1] - ef * g[0]) / below
        y = e * y0 + f * y1
        return rows(y, d * y0 - y * s[0], d * y1 - y * s[1])

    @wp.func
    def sweep_barycentric(u: R3, g: R3, d: R3, a: R3, b: R3, c: R3):
        zero = S(0.0)
        gp = R3()
        ga = R3()
        gb = R3()
        gc = R3()
        if u[0] > zero and u[1] > zero and u[2] > zero:
            m = along_two(d, R2(u[1], u[2]), b - a, c - a, R2(g[1] - g[0], g[2] - g[0]))
            gp = R3(m[0, 0], m[0, 1], m[0, 2])
            gb = R3(m[1, 0], m[1, 1], m[1, 2])
            gc = R3(m[2, 0], m[2, 1], m[2, 2])
            ga = -(gp + gb + gc)
        elif u[0] > zero and u[1] > zero:
            e = b - a
            y = (g[1] - g[0]) / wp.dot(e, e)
            gp = e * y
            gb = d * y - gp * u[1]
            ga = -(gp + gb)
        elif u[0] > zero and u[2] > zero:
            e = c - a
            y = (g[2] - g[0]) / wp.dot(e, e)
            gp = e * y
            gc = d * y - gp * u[2]
            ga = -(gp + gc)
        elif u[1] > zero and u[2] > zero:
            e = c - b
            y = (g[2] - g[1]) / wp.dot(e, e)
            gp = e * y
            gc = d * y - gp * u[2]
            gb = -(gp + gc)
        return gp, ga, gb, gc

    return SimpleNamespace(along_two=along_two, sweep_barycentric=sweep_barycentric)
