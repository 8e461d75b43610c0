"""Boxes on the table: the corners of every box against the plane z = 0, then friction."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .friction import friction
from .rigid import rigid
from .structures import structures

__all__ = ["box_table"]

NORMAL_PASSES = 2
"""Passes over the corners; the second evens out what the order of the first one left."""
TOUCHING = 2.0e-5
"""A corner lower than this [m] takes its share of the friction."""


@functools.cache
def box_table(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_table(b, first, last, ...)`: body b with shapes first..last; returns corners in contact.

    All normal corrections come before friction, and the Coulomb budget is shared evenly between the
    corners that touch; solved corner by corner, a lone cube would creep by 5 mm/s.
    """
    t = structures(scalar, lanes)
    S, R3, Shapes, Bodies = t.S, t.R3, t.Shapes, t.Bodies
    body = rigid(scalar, lanes)
    response, push_body, moved = body.response, body.push_body, body.moved
    coulomb_scalar = friction(scalar, lanes).coulomb_scalar

    @wp.func
    def corner(shape: int, c: int, shapes: Shapes):
        """Corner c (0..7) of a shape in the body's frame [m]."""
        h = shapes.half[shape]
        sign = R3(
            S(2.0) * S(c & 1) - S(1.0), S((c & 2) - 1), S(2.0) * S((c & 4) >> 2) - S(1.0)
        )  # fmt: skip
        at = wp.quat_rotate(shapes.rotation[shape], wp.cw_mul(h, sign))
        return shapes.center[shape] + at

    @wp.func
    def project_table(
        b: int, local: int, first: int, last: int, mu: S, shapes: Shapes, bodies: Bodies
    ):
        up = R3(S(0.0), S(0.0), S(1.0))
        normal = S(0.0)
        contacts = int(0)
        for step in range(wp.static(NORMAL_PASSES)):
            for shape in range(first, last):
                if shapes.body[shape] == local:
                    for c in range(8):
                        r = wp.quat_rotate(bodies.q[b], corner(shape, c, shapes))
                        z = bodies.x[b][2] + r[2]
                        if z < S(0.0):
                            push = -z / response(b, bodies, r, up)
                            normal += push
                            push_body(b, bodies, r, up * push)
        touching = int(0)
        for shape in range(first, last):
            if shapes.body[shape] == local:
                for c in range(8):
                    if bodies.x[b][2] + wp.quat_rotate(bodies.q[b], corner(shape, c, shapes))[2] < S(
                        TOUCHING
                    ):
                        touching += 1
        if normal > S(0.0) and touching > 0:
            budget = normal / S(touching)
            for shape in range(first, last):
                if shapes.body[shape] == local:
                    for c in range(8):
                        at = corner(shape, c, shapes)
                        r = wp.quat_rotate(bodies.q[b], at)
                        if bodies.x[b][2] + r[2] < S(TOUCHING):
                            d = moved(b, bodies, at)
                            d[2] = S(0.0)
                            l = wp.length(d)
                            if l > S(1.0e-12):
                                n = d / l
                                w = response(b, bodies, r, n)
                                f = coulomb_scalar(
                                    l * l, mu * shapes.friction[shape] * budget * w
                                )
                                push_body(b, bodies, r, n * (-f * l / w))
            contacts = touching
        return contacts

    return SimpleNamespace(project_table=project_table, corner=corner)
