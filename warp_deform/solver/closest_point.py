"""The point of a triangle that is nearest to a given point."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .structures import structures

__all__ = ["closest_point"]


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
