"""Where a box of a body is and how it is turned, and the axes that may part it from another."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures

__all__ = ["box_axes"]


@functools.cache
def box_axes(scalar: Any, lanes: int) -> SimpleNamespace:
    """`center(shape, b, ...)` and `axes(shape, b, ...)` of a shape of body b; of axes m,
    `column(m, k)` and `reach(m, half, n)`; `candidate(aa, ab, k)`, the normals of the separating
    axis theorem.
    """
    t = structures(scalar, lanes)
    R3, M33 = t.R3, t.M33
    Shapes, Bodies = t.Shapes, t.Bodies

    @wp.func
    def center(shape: int, b: int, shapes: Shapes, bodies: Bodies):
        """The middle of the box [m]."""
        return bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])

    @wp.func
    def axes(shape: int, b: int, shapes: Shapes, bodies: Bodies):
        """The box's axes as columns (3, 3)."""
        return wp.quat_to_matrix(bodies.q[b] * shapes.rotation[shape])

    @wp.func
    def column(m: M33, k: int):
        return R3(m[0, k], m[1, k], m[2, k])

    @wp.func
    def reach(m: M33, half: R3, n: R3):
        """Half width of a box with axes m along the unit vector n [m]."""
        return (
            wp.abs(wp.dot(column(m, 0), n)) * half[0]
            + wp.abs(wp.dot(column(m, 1), n)) * half[1]
            + wp.abs(wp.dot(column(m, 2), n)) * half[2]
        )

    @wp.func
    def candidate(aa: M33, ab: M33, k: int):
        """Axis k of 15: the faces of one box and of the other, then edges across edges, not of
        length 1.
        """
        n = R3()
        if k < 3:
            n = column(aa, k)
        elif k < 6:
            n = column(ab, k - 3)
        else:
            n = wp.cross(column(aa, (k - 6) // 3), column(ab, (k - 6) % 3))
        return n

    return SimpleNamespace(
        center=center, axes=axes, column=column, reach=reach, candidate=candidate
    )
