"""Boxes on the table: the corners of every box against the plane z = 0."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .body_contact import AHEAD, body_contact
from .rigid_body_adjoint import rigid_body_adjoint

__all__ = ["box_table", "box_table_adjoint"]


@functools.cache
def box_table(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """`list_table(c, b, local, first, last, ...)`: adds the corners of body b with shapes
    first..last that may touch the table to the contacts, from number c on; returns the next number.

    Args:
        noted: with the number of the corner in `Contacts.code`
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Shapes, Bodies, Contacts = t.Shapes, t.Bodies, t.Contacts
    contact = body_contact(scalar, lanes, noted)
    list_contact = contact.list_contact

    @wp.func
    def corner(shape: int, c: int, shapes: Shapes):
        """Corner c (0..7) of a shape in the body's frame [m]."""
        h = shapes.half[shape]
        sign = R3(S(2.0) * S(c & 1) - S(1.0), S((c & 2) - 1), S(2.0) * S((c & 4) >> 2) - S(1.0))
        at = wp.quat_rotate(shapes.rotation[shape], wp.cw_mul(h, sign))
        return shapes.center[shape] + at

    @wp.func
    def list_table(
        c: int,
        b: int,
        local: int,
        first: int,
        last: int,
        mu: S,
        max_recovery: S,
        shapes: Shapes,
        bodies: Bodies,
        contacts: Contacts,
    ):
        up = R3(S(0.0), S(0.0), S(1.0))
        for shape in range(first, last):
            if shapes.body[shape] == local:
                for k in range(8):
                    p = bodies.x[b] + wp.quat_rotate(bodies.q[b], corner(shape, k, shapes))
                    if p[2] < S(AHEAD):
                        foot = R3(p[0], p[1], S(0.0))
                        table_mu = mu * shapes.friction[shape]
                        list_contact(
                            c, -1, b, foot, p, up, table_mu, max_recovery, bodies, contacts
                        )
                        if wp.static(noted):
                            contacts.code[c] = wp.vec4i(-1, shape, k, 0)
                        c += 1
        return c

    return SimpleNamespace(list_table=list_table, corner=corner)


@functools.cache
def box_table_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_table(b, code, by_foot, by_corner, ...)` gives the derivatives by a corner and by its
    foot on the table to the pose of body b.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Shapes, Bodies, BodyAdjoint = t.Shapes, t.Bodies, t.BodyAdjoint
    corner = box_table(scalar, lanes, True).corner
    rotate_adjoint = rigid_body_adjoint(scalar, lanes).rotate_adjoint

    @wp.func
    def sweep_table(
        b: int,
        code: wp.vec4i,
        by_foot: R3,
        by_corner: R3,
        shapes: Shapes,
        bodies: Bodies,
        ba: BodyAdjoint,
    ):
        g = by_corner + R3(by_foot[0], by_foot[1], S(0.0))
        ba.x[b] = ba.x[b] + g
        local = corner(code[1], code[2], shapes)
        ba.q[b] = ba.q[b] + rotate_adjoint(local, bodies.q[b], g)

    return SimpleNamespace(sweep_table=sweep_table)
