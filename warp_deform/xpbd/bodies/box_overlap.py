"""How deep boxes lie in each other and under the table, for the guards."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .box_axes import box_axes

__all__ = ["box_overlap"]

PARALLEL = 1.0e-3
"""Edges whose cross product is shorter than this give no axis that the faces do not give."""


@functools.cache
def box_overlap(scalar: Any, lanes: int) -> SimpleNamespace:
    """`overlap_share(sa, a, sb, b, ...)` and `corner_depth(shape, b, ...)`."""
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Shapes, Bodies = t.Shapes, t.Bodies
    box = box_axes(scalar, lanes)
    center, axes, reach, candidate = box.center, box.axes, box.reach, box.candidate

    @wp.func
    def thinnest(half: R3):
        """Shortest side of a box [m]."""
        return S(2.0) * wp.min(half[0], wp.min(half[1], half[2]))

    @wp.func
    def overlap_share(sa: int, a: int, sb: int, b: int, shapes: Shapes, bodies: Bodies):
        """How deep shape sa of body a and shape sb of body b lie in each other, over the shortest
        side of the two; 0 apart.

        The depth is the least way that parts them: the least overlap of their shadows along the
        normals of the faces of their Minkowski difference, of which two boxes have 15 at most.
        Source: Gottschalk, Lin, Manocha, "OBBTree", 1996 (axes); Ericson, Real-Time Collision
        Detection, sections 4.4 and 9.3.
        """
        ha = shapes.half[sa]
        hb = shapes.half[sb]
        d = center(sb, b, shapes, bodies) - center(sa, a, shapes, bodies)
        share = S(0.0)
        radii = wp.length(ha) + wp.length(hb)
        if wp.dot(d, d) < radii * radii:
            aa = axes(sa, a, shapes, bodies)
            ab = axes(sb, b, shapes, bodies)
            depth = S(1.0e9)
            k = int(0)
            while k < 15 and depth > S(0.0):
                n = candidate(aa, ab, k)
                l = wp.length(n)
                if l > S(PARALLEL):
                    n = n / l
                    apart = wp.abs(wp.dot(d, n))
                    depth = wp.min(depth, reach(aa, ha, n) + reach(ab, hb, n) - apart)
                k += 1
            share = wp.max(depth, S(0.0)) / wp.min(thinnest(ha), thinnest(hb))
        return share

    @wp.func
    def corner_depth(shape: int, b: int, shapes: Shapes, bodies: Bodies):
        """How deep the lowest corner of a shape of body b is under the table [m]; below 0 above."""
        middle = center(shape, b, shapes, bodies)
        up = R3(S(0.0), S(0.0), S(1.0))
        return reach(axes(shape, b, shapes, bodies), shapes.half[shape], up) - middle[2]

    return SimpleNamespace(overlap_share=overlap_share, corner_depth=corner_depth)
