"""Adjoint of the contacts of bodies with each other and the table, see `body_contact`.

The sweep lists and solves them again, from the poses on the tape and with every visit noted, and
goes back through the visits (`body_visits_adjoint`). For functions called `..._loss` see
`rigid_body_adjoint`.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .body_visits_adjoint import body_visits_adjoint
from .overlap_recovery import overlap_recovery
from .rigid_body import rigid_body

__all__ = ["body_contact_adjoint"]


@functools.cache
def body_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_end_body`, `sweep_listed`, `sweep_spread` take back `end_body`, the listing of each
    contact, and `begin_body`; before the second come the visits.

    Branch: the overlap that is given back.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Bodies, Contacts, BodyAdjoint = t.Bodies, t.Contacts, t.BodyAdjoint
    turned = rigid_body(scalar, lanes).turned
    remaining = overlap_recovery(scalar).remaining
    add_mass = body_visits_adjoint(scalar, lanes).add_mass

    @wp.func
    def dot4(a: Q, b: Q):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]

    @wp.func
    def pose_loss(q: Q, dr: R3, g: Q) -> S:
        return dot4(g, turned(q, dr))

    @wp.func
    def sweep_end_body(b: int, start_q: Q, bodies: Bodies, ba: BodyAdjoint):
        gq, gr, _g = wp.grad(pose_loss)(start_q, bodies.dr[b], ba.q[b])
        ba.q[b] = gq
        ba.dx[b] = ba.x[b]
        ba.dr[b] = gr
        ba.spread[b] = M33()

    @wp.func
    def spread_loss(q: Q, inverse: M33, g: M33) -> S:
        turn = wp.quat_to_matrix(q)
        return wp.ddot(g, turn * inverse * wp.transpose(turn))

    @wp.func
    def sweep_spread(b: int, bodies: Bodies, ba: BodyAdjoint):
        if bodies.w[b] > S(0.0):
            gq, _i, _g = wp.grad(spread_loss)(bodies.q[b], bodies.inverse_inertia[b], ba.spread[b])
            ba.q[b] = ba.q[b] + gq

    @wp.func
    def clear_contacts(start: int, end: int, ba: BodyAdjoint):
        for c in range(start, end):
            ba.ra[c] = R3()
            ba.rb[c] = R3()
            ba.normal[c] = R3()
            ba.across_u[c] = R3()
            ba.across_v[c] = R3()
            ba.weights[c] = R3()
            ba.upper[c] = R3()
            ba.steps[c] = R3()
            ba.impulse[c] = R3()
            ba.mu[c] = S(0.0)

    @wp.func
    def step_of(x: R3, q: Q, xp: R3, qp: Q, r: R3):
        local = wp.quat_rotate_inv(q, r)
        return x + wp.quat_rotate(q, local) - (xp + wp.quat_rotate(qp, local))

    @wp.func
    def weights_loss(w: S, spread: M33, r: R3, n: R3, u: R3, v: R3, g: R3):
        rn = wp.cross(r, n)
        ru = wp.cross(r, u)
        rv = wp.cross(r, v)
        return (
            g[0] * (w + wp.dot(rn, spread * rn))
            + g[1] * (w + wp.dot(ru, spread * ru))
            + g[2] * (w + wp.dot(rv, spread * rv))
        )

    @wp.struct
    class ListedBody:
        """A body when a contact is listed, and the contact's point on it."""

        point: R3
        x: R3
        q: Q
        xp: R3
        qp: Q
        w: S
        spread: M33

    @wp.struct
    class ByContact:
        """Derivatives of the loss by what `list_contact` makes of two points and a normal."""

        ra: R3
        rb: R3
        normal: R3
        u: R3
        v: R3
        weights: R3
        upper: R3
        steps: R3

    @wp.func
    def listed_body(b: int, point: R3, bodies: Bodies):
        body = ListedBody()
        body.point = point
        body.x = bodies.x[b]
        body.q = bodies.q[b]
        body.xp = bodies.xp[b]
        body.qp = bodies.qp[b]
        body.w = bodies.w[b]
        body.spread = bodies.spread[b]
        return body

    @wp.func
    def add_to_body(b: int, g: ListedBody, bodies: Bodies, ba: BodyAdjoint):
        ba.x[b] = ba.x[b] + g.x
        ba.q[b] = ba.q[b] + g.q
        ba.xp[b] = ba.xp[b] + g.xp
        ba.qp[b] = ba.qp[b] + g.qp
        add_mass(b, g.w, bodies, ba)
        ba.spread[b] = ba.spread[b] + g.spread

    @wp.func
    def listing_loss(
        a: ListedBody, b: ListedBody, two: S, max_recovery: S, n: R3, by: ByContact
    ) -> S:
        """The derivatives `by` the contact times what `list_contact` notes of it; `two`: 1, or 0
        where a is the table.
        """
        pa = a.point
        xa = a.x
        qa = a.q
        xpa = a.xp
        qpa = a.qp
        wa = a.w
        sa = a.spread
        pb = b.point
        xb = b.x
        qb = b.q
        xpb = b.xp
        qpb = b.qp
        wb = b.w
        sb = b.spread
        gs = by.steps
        gw = by.weights
        rb = pb - xb
        ra = pa - xa
        slip = step_of(xb, qb, xpb, qpb, rb) - step_of(xa, qa, xpa, qpa, ra) * two
        axis = R3(S(1.0), S(0.0), S(0.0))
        if wp.abs(n[0]) > S(0.7):
            axis = R3(S(0.0), S(1.0), S(0.0))
        u = wp.normalize(wp.cross(n, axis))
        v = wp.cross(n, u)
        gap = wp.dot(pb - pa, n)
        overlap = wp.max(wp.dot(slip, n) - gap, S(0.0))
        left = remaining(overlap, max_recovery)
        total = gs[0] * (gap + left) + gs[1] * wp.dot(slip, u) + gs[2] * wp.dot(slip, v)
        total += weights_loss(wb, sb, rb, n, u, v, gw + by.upper)
        total += weights_loss(wa, sa, ra, n, u, v, gw) * two
        total += wp.dot(by.ra, ra) * two + wp.dot(by.rb, rb)
        return total + wp.dot(by.normal, n) + wp.dot(by.u, u) + wp.dot(by.v, v)

    @wp.func
    def sweep_listed(
        c: int, pa: R3, pb: R3, max_recovery: S, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint
    ):
        """Takes contact c back to its points and its normal; returns the derivatives by these."""
        a = contacts.a[c]
        b = contacts.b[c]
        n = contacts.normal[c]
        two = S(0.0)
        oa = b
        if a >= 0:
            two = S(1.0)
            oa = a
        by = ByContact()
        by.ra = ba.ra[c]
        by.rb = ba.rb[c]
        by.normal = ba.normal[c]
        by.u = ba.across_u[c]
        by.v = ba.across_v[c]
        by.weights = ba.weights[c]
        by.upper = ba.upper[c]
        by.steps = ba.steps[c]
        ga, gb, _two, _recovery, g_normal, _by = wp.grad(listing_loss)(
            listed_body(oa, pa, bodies), listed_body(b, pb, bodies), two, max_recovery, n, by
        )
        add_to_body(b, gb, bodies, ba)
        if a >= 0:
            add_to_body(a, ga, bodies, ba)
        return ga.point, gb.point, g_normal

    return SimpleNamespace(
        sweep_end_body=sweep_end_body,
        sweep_spread=sweep_spread,
        sweep_listed=sweep_listed,
        clear_contacts=clear_contacts,
    )
