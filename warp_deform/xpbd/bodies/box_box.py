"""Where boxes touch each other.

The axis of least overlap among the 15 candidates of two boxes (separating axis theorem) is the
contact normal. For a face axis the contact points are the corners of the area that the face and the
other box's facing side have in common. For an edge axis they are the two edges' closest points.
Source: Ericson, Real-Time Collision Detection, sections 4.4 and 5.5.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .body_contact import AHEAD, body_contact
from .box_axes import box_axes

__all__ = ["POINTS", "box_box"]

FLUSH = 2.0e-5
"""Edges that miss a face by less are on it [m]: of equal boxes they coincide, and rounding decides
on which side they are."""
INSIDE = 1.0e-5
"""Corners of a face that are inside the other one by more are contacts, too [m]."""
EVEN = 2.0e-6
"""What separates the overlaps along two axes at least, for the later one to be chosen [m]."""
CROSSED = 2.0e-5
"""The same if the later one is that of two edges."""
POINTS = 12
"""Most contacts of two boxes: 8 ends of edges and 4 corners."""


@functools.cache
def box_box(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """`list_boxes(c, sa, a, sb, b, ...)`: adds the contacts of shape sa of body a with shape sb of
    body b to the list, from number c on, and returns the next number.

    Args:
        noted: with the axis, edge and end in `Contacts.code`
    """
    t = structures(scalar, lanes)
    S, R3, M33 = t.S, t.R3, t.M33
    Shapes, Bodies, Contacts = t.Shapes, t.Bodies, t.Contacts
    contact, box = body_contact(scalar, lanes, noted), box_axes(scalar, lanes)
    list_contact = contact.list_contact
    center, axes, column, reach, candidate = (
        box.center,
        box.axes,
        box.column,
        box.reach,
        box.candidate,
    )

    @wp.func
    def list_face(
        c: int,
        sa: int,
        a: int,
        sb: int,
        b: int,
        axis: int,
        n: R3,
        ca: R3,
        aa: M33,
        ha: R3,
        cb: R3,
        ab: M33,
        hb: R3,
        mu: S,
        max_recovery: S,
        bodies: Bodies,
        contacts: Contacts,
    ):
        """Contacts between the face of box a with outward normal n (its axis `axis`) and the side
        of box b that faces it: the corners of their common area. Returns the next number.
        """
        u = column(aa, (axis + 1) % 3)
        v = column(aa, (axis + 2) % 3)
        hu = ha[(axis + 1) % 3]
        hv = ha[(axis + 2) % 3]
        # side of b most opposed to n
        k = int(0)
        best = S(0.0)
        for e in range(3):
            opposed = wp.abs(wp.dot(column(ab, e), n))
            if opposed > best:
                best = opposed
                k = e
        m = column(ab, k) * wp.sign(wp.dot(column(ab, k), n))
        bu = column(ab, (k + 1) % 3)
        bv = column(ab, (k + 2) % 3)
        eu = bu * hb[(k + 1) % 3]
        ev = bv * hb[(k + 2) % 3]
        side = cb - m * hb[k]
        face = wp.dot(ca, n) + ha[axis]
        for edge in range(4):
            s0 = S(1.0)
            if edge == 1 or edge == 2:
                s0 = S(-1.0)
            s1 = S(1.0)
            if edge >= 2:
                s1 = S(-1.0)
            # corners of b's side in order around it, its edges cut off at a's face
            p = side + eu * s0 + ev * s1
            d = eu * (S(-2.0) * s0)
            if edge == 1 or edge == 3:
                d = ev * (S(-2.0) * s1)
            lo = S(0.0)
            hi = S(1.0)
            pu = wp.dot(p - ca, u)
            pv = wp.dot(p - ca, v)
            du = wp.dot(d, u)
            dv = wp.dot(d, v)
            wu = hu + S(FLUSH)
            wv = hv + S(FLUSH)
            if wp.abs(du) > S(1.0e-9):
                lo = wp.max(lo, wp.min((-wu - pu) / du, (wu - pu) / du))
                hi = wp.min(hi, wp.max((-wu - pu) / du, (wu - pu) / du))
            elif wp.abs(pu) > wu:
                hi = S(-1.0)
            if wp.abs(dv) > S(1.0e-9):
                lo = wp.max(lo, wp.min((-wv - pv) / dv, (wv - pv) / dv))
                hi = wp.min(hi, wp.max((-wv - pv) / dv, (wv - pv) / dv))
            elif wp.abs(pv) > wv:
                hi = S(-1.0)
            if lo <= hi + S(1.0e-6):
                for end in range(2):
                    # the far end of an edge that is not cut off is the near end of the next one
                    if end == 0 or (hi < S(1.0) and lo < hi):
                        at = p + d * wp.where(end == 0, lo, hi)
                        gap = wp.dot(at, n) - face
                        if gap < S(AHEAD):
                            list_contact(
                                c, a, b, at - n * gap, at, n, mu, max_recovery, bodies, contacts
                            )
                            if wp.static(noted):
                                contacts.code[c] = wp.vec4i(sa, sb, edge * 4 + end, axis * 4 + k)
                            c += 1
            # corner of a's face inside b's side
            q = ca + n * ha[axis] + u * (hu * s0) + v * (hv * s1)
            if wp.abs(wp.dot(q - cb, bu)) < hb[(k + 1) % 3] - S(INSIDE) and wp.abs(
                wp.dot(q - cb, bv)
            ) < hb[(k + 2) % 3] - S(INSIDE):
                gap = wp.dot(side - q, m) / wp.dot(m, n)
                if gap < S(AHEAD):
                    list_contact(c, a, b, q, q + n * gap, n, mu, max_recovery, bodies, contacts)
                    if wp.static(noted):
                        contacts.code[c] = wp.vec4i(sa, sb, edge * 4 + 2, axis * 4 + k)
                    c += 1
        return c

    @wp.func
    def list_boxes(
        c: int,
        sa: int,
        a: int,
        sb: int,
        b: int,
        mu: S,
        max_recovery: S,
        shapes: Shapes,
        bodies: Bodies,
        contacts: Contacts,
    ):
        ha = shapes.half[sa]
        hb = shapes.half[sb]
        ca = center(sa, a, shapes, bodies)
        cb = center(sb, b, shapes, bodies)
        d = cb - ca
        if wp.dot(d, d) < (wp.length(ha) + wp.length(hb)) * (wp.length(ha) + wp.length(hb)):
            aa = axes(sa, a, shapes, bodies)
            ab = axes(sb, b, shapes, bodies)
            least = S(1.0e9)
            kind = int(-1)
            normal = R3()
            for k in range(15):
                n = candidate(aa, ab, k)
                # a later axis must win clearly: else rounding decides between the faces of two
                # boxes, or between a face and edges that are nearly parallel to it
                bias = wp.where(k < 6, S(1.0), S(1.05))
                handicap = S(0.0)
                if k >= 6:
                    handicap = S(CROSSED)
                elif k >= 3:
                    handicap = S(EVEN)
                l = wp.length(n)
                if l > S(1.0e-3) and least > S(0.0):
                    n = n / l
                    overlap = reach(aa, ha, n) + reach(ab, hb, n) - wp.abs(wp.dot(d, n)) + S(AHEAD)
                    if overlap <= S(0.0):
                        least = S(-1.0)
                    elif overlap * bias + handicap < least:
                        least = overlap * bias + handicap
                        kind = k
                        normal = n * wp.where(wp.dot(d, n) < S(0.0), S(-1.0), S(1.0))
            if least > S(0.0) and kind >= 0:
                if kind < 3:
                    c = list_face(
                        c,
                        sa,
                        a,
                        sb,
                        b,
                        kind,
                        normal,
                        ca,
                        aa,
                        ha,
                        cb,
                        ab,
                        hb,
                        mu,
                        max_recovery,
                        bodies,
                        contacts,
                    )
                elif kind < 6:
                    c = list_face(
                        c,
                        sb,
                        b,
                        sa,
                        a,
                        kind - 3,
                        -normal,
                        cb,
                        ab,
                        hb,
                        ca,
                        aa,
                        ha,
                        mu,
                        max_recovery,
                        bodies,
                        contacts,
                    )
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
                    pa += u * su
                    pb += v * sv
                    list_contact(c, a, b, pa, pb, normal, mu, max_recovery, bodies, contacts)
                    if wp.static(noted):
                        contacts.code[c] = wp.vec4i(sa, sb, 16, ea * 4 + eb)
                    c += 1
        return c

    return SimpleNamespace(list_boxes=list_boxes)
