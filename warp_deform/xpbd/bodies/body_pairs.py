"""Which contacts of a world's bodies with each other and the table there are, in a fixed order."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .body_contact import body_contact
from .box_box import box_box
from .box_table import box_table

__all__ = ["body_pairs"]


@functools.cache
def body_pairs(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """`list_pairs(g, lane, k, ...)`: lists the contacts of one lane's bodies at their present
    poses and returns where they end; they start at `group.contact_start[g]`.

    Also begins the bodies; `noted`: see `body_contact`.
    """
    t = structures(scalar, lanes)
    S = t.S
    Topology, Shapes, Group = t.Topology, t.Shapes, t.Group
    Bodies, Contacts = t.Bodies, t.Contacts
    list_boxes = box_box(scalar, lanes, noted).list_boxes
    list_table = box_table(scalar, lanes, noted).list_table
    begin_body = body_contact(scalar, lanes, noted).begin_body

    @wp.func
    def list_pairs(
        g: int,
        lane: int,
        k: int,
        max_recovery: S,
        top: Topology,
        shapes: Shapes,
        group: Group,
        bodies: Bodies,
        contacts: Contacts,
    ):
        count = top.body_count[k]
        b0 = group.body_start[g] + lane * count
        first = group.shape_start[g] + lane * top.shape_count[k]
        last = first + top.shape_count[k]
        mv = group.contact_friction[g]
        tv = group.table_friction[g]
        for b in range(b0, b0 + count):
            begin_body(b, bodies)
        c = int(group.contact_start[g])
        for sa in range(first, last):
            for sb in range(sa + 1, last):
                a = b0 + shapes.body[sa]
                b = b0 + shapes.body[sb]
                if a != b and bodies.w[a] + bodies.w[b] > S(0.0):
                    mu = mv[lane] * wp.min(shapes.friction[sa], shapes.friction[sb])
                    c = list_boxes(c, sa, a, sb, b, mu, max_recovery, shapes, bodies, contacts)
        for b in range(count):
            if bodies.w[b0 + b] > S(0.0):
                c = list_table(
                    c, b0 + b, b, first, last, tv[lane], max_recovery, shapes, bodies, contacts
                )
        return c

    return SimpleNamespace(list_pairs=list_pairs)
