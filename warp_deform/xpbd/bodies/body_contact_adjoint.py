"""Adjoint of the contacts of bodies with each other and the table, see `body_contact`.

The sweep lists and solves them again, from the poses on the tape and with every visit noted, and
goes back through the visits: corrections are undone one by one, so every visit finds the state that
it met. For functions called `..._loss` see `rigid_body_adjoint`.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind
from .body_contact import GIVEN_BACK, VISIT, body_contact
from .rigid_body import rigid_body

__all__ = ["body_contact_adjoint"]


@functools.cache
def body_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_end_body`, `sweep_visits`, `sweep_listed`, `sweep_spread` in this order take back
    `end_body`, the passes, each contact's first guess and listing, and `begin_body`.

    Branches: an impulse at 0, friction at its budget, the overlap that is given back.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Bodies, Contacts, BodyAdjoint, Adjoint = t.Bodies, t.Contacts, t.BodyAdjoint, t.Adjoint
    count_one = lane_access(scalar, lanes).count_one
    turned = rigid_body(scalar, lanes).turned
    relative = body_contact(scalar, lanes, True).relative
    TINY = 1.0e-36 if scalar is wp.float32 else 1.0e-200

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
    def add_mass(b: int, g: S, bodies: Bodies, ba: BodyAdjoint):
        """Derivative by inverse mass; a held body's is 0 whatever it is when free."""
        if bodies.w[b] > S(0.0):
            ba.w[b] = ba.w[b] + g

    @wp.func
    def sweep_apply_to(b: int, r: R3, impulse: R3, bodies: Bodies, ba: BodyAdjoint):
        """`apply` to one body: derivatives by its inverse masses; returns those by impulse."""
        gx = ba.dx[b]
        gr = ba.dr[b]
        add_mass(b, wp.dot(gx, impulse), bodies, ba)
        ba.spread[b] = ba.spread[b] + wp.outer(gr, wp.cross(r, impulse))
        return gx * bodies.w[b] + wp.cross(bodies.spread[b] * gr, r)

    @wp.func
    def sweep_apply(c: int, impulse: R3, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        b = contacts.b[c]
        rb = contacts.rb[c]
        g = sweep_apply_to(b, rb, impulse, bodies, ba)
        ba.rb[c] = ba.rb[c] + wp.cross(impulse, bodies.spread[b] * ba.dr[b])
        bodies.dx[b] = bodies.dx[b] - impulse * bodies.w[b]
        bodies.dr[b] = bodies.dr[b] - bodies.spread[b] * wp.cross(rb, impulse)
        a = contacts.a[c]
        if a >= 0:
            ra = contacts.ra[c]
            g -= sweep_apply_to(a, ra, -impulse, bodies, ba)
            ba.ra[c] = ba.ra[c] - wp.cross(impulse, bodies.spread[a] * ba.dr[a])
            bodies.dx[a] = bodies.dx[a] + impulse * bodies.w[a]
            bodies.dr[a] = bodies.dr[a] + bodies.spread[a] * wp.cross(ra, impulse)
        return g

    @wp.func
    def sweep_relative(c: int, g: R3, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        b = contacts.b[c]
        ba.dx[b] = ba.dx[b] + g
        ba.dr[b] = ba.dr[b] + wp.cross(contacts.rb[c], g)
        ba.rb[c] = ba.rb[c] + wp.cross(g, bodies.dr[b])
        a = contacts.a[c]
        if a >= 0:
            ba.dx[a] = ba.dx[a] - g
            ba.dr[a] = ba.dr[a] - wp.cross(contacts.ra[c], g)
            ba.ra[c] = ba.ra[c] - wp.cross(g, bodies.dr[a])

    @wp.func
    def sweep_visit(c: int, at: int, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        new = contacts.impulse[c]
        old = R3(contacts.log[at], contacts.log[at + 1], contacts.log[at + 2])
        if new[0] > S(0.0) or old[0] > S(0.0):
            n = contacts.normal[c]
            u = contacts.u[c]
            v = contacts.v[c]
            w = contacts.weights[c]
            mu = contacts.mu[c]
            gi = ba.impulse[c]
            gs = ba.steps[c]
            gw = ba.weights[c]
            # the step across
            su = new[1] - old[1]
            sv = new[2] - old[2]
            g = sweep_apply(c, u * su + v * sv, bodies, contacts, ba)
            gu = gi[1] + wp.dot(g, u)
            gv = gi[2] + wp.dot(g, v)
            back = R3(S(0.0), -wp.dot(g, u), -wp.dot(g, v))
            by_u = g * su
            by_v = g * sv
            normal = new[0]
            g_normal = gi[0]
            fu = contacts.log[at + 3]
            fv = contacts.log[at + 4]
            budget = mu * normal
            f = wp.sqrt(fu * fu + fv * fv)
            if f > budget:
                g_budget = (fu * gu + fv * gv) / f
                turn = g_budget / f
                gu = (gu - fu * turn) * (budget / f)
                gv = (gv - fv * turn) * (budget / f)
                ba.mu[c] = ba.mu[c] + g_budget * normal
                g_normal += g_budget * mu
            back[1] = back[1] + gu
            back[2] = back[2] + gv
            gs[1] = gs[1] - gu / w[1]
            gs[2] = gs[2] - gv / w[2]
            gw[1] = gw[1] + gu * (old[1] - fu) / w[1]
            gw[2] = gw[2] + gv * (old[2] - fv) / w[2]
            d = relative(c, bodies, contacts)
            by_u -= d * (gu / w[1])
            by_v -= d * (gv / w[2])
            sweep_relative(c, -(u * (gu / w[1]) + v * (gv / w[2])), bodies, contacts, ba)
            # the step along the normal
            step = normal - old[0]
            g = sweep_apply(c, n * step, bodies, contacts, ba)
            by_n = g * step
            g_normal += wp.dot(g, n)
            back[0] = -wp.dot(g, n)
            if normal > S(0.0):
                back[0] = back[0] + g_normal
                gs[0] = gs[0] - g_normal / w[0]
                gw[0] = gw[0] + g_normal * (old[0] - normal) / w[0]
                d = relative(c, bodies, contacts)
                by_n -= d * (g_normal / w[0])
                sweep_relative(c, -n * (g_normal / w[0]), bodies, contacts, ba)
            ba.impulse[c] = back
            ba.steps[c] = gs
            ba.weights[c] = gw
            ba.normal[c] = ba.normal[c] + by_n
            ba.across_u[c] = ba.across_u[c] + by_u
            ba.across_v[c] = ba.across_v[c] + by_v
        contacts.impulse[c] = old

    @wp.func
    def clear_contacts(start: int, end: int, ba: BodyAdjoint):
        for c in range(start, end):
            ba.ra[c] = R3()
            ba.rb[c] = R3()
            ba.normal[c] = R3()
            ba.across_u[c] = R3()
            ba.across_v[c] = R3()
            ba.weights[c] = R3()
            ba.steps[c] = R3()
            ba.impulse[c] = R3()
            ba.mu[c] = S(0.0)

    @wp.func
    def sweep_visits(
        start: int,
        end: int,
        passes: int,
        log: int,
        lane: int,
        counts: int,
        bodies: Bodies,
        contacts: Contacts,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        for c in range(start, end):
            held = contacts.impulse[c]
            if held[0] > S(0.0):
                kind = int(counts) + wp.static(int(Kind.BODY_TABLE))
                if contacts.a[c] >= 0:
                    kind = int(counts) + wp.static(int(Kind.BODY_BODY))
                count_one(kind, lane, adj)
                across = wp.sqrt(held[1] * held[1] + held[2] * held[2])
                if across > S(0.999) * contacts.mu[c] * held[0]:
                    kind = int(counts) + wp.static(int(Kind.BODY_SLIP))
                    count_one(kind, lane, adj)
        count = end - start
        for back in range(passes):
            p = passes - 1 - back
            for r in range(count):
                k = count - 1 - r
                c = start + k
                if p % 2 == 1:
                    c = end - 1 - k
                at = log + (p * count + k) * wp.static(VISIT)
                sweep_visit(c, at, bodies, contacts, ba)

    @wp.func
    def first_guess_loss(
        s: R3, total: S, mu: S, sharing: S, n: R3, u: R3, v: R3, gi: R3, g: R3
    ) -> S:
        part = S(1.0) / (total * sharing)
        normal = wp.max(-s[0], S(0.0)) * part
        fu = -s[1] * part
        fv = -s[2] * part
        f2 = fu * fu + fv * fv
        budget = mu * normal
        share = S(1.0)
        if f2 > budget * budget:
            share = budget / wp.sqrt(wp.max(f2, S(TINY)))
        impulse = n * normal + u * (fu * share) + v * (fv * share)
        return wp.dot(g, impulse) + gi[0] * normal + (gi[1] * fu + gi[2] * fv) * share

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
        remaining = wp.max(overlap - max_recovery, overlap * S(1.0 - GIVEN_BACK))
        total = gs[0] * (gap + remaining) + gs[1] * wp.dot(slip, u) + gs[2] * wp.dot(slip, v)
        total += weights_loss(wb, sb, rb, n, u, v, gw) + weights_loss(wa, sa, ra, n, u, v, gw) * two
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
        u = contacts.u[c]
        v = contacts.v[c]
        s = contacts.steps[c]
        code = contacts.code[c]
        impulse = contacts.impulse[c]
        total = bodies.w[b]
        two = S(0.0)
        if a >= 0:
            total += bodies.w[a]
            two = S(1.0)
        g = sweep_apply(c, n * impulse[0] + u * impulse[1] + v * impulse[2], bodies, contacts, ba)
        gs, g_total, g_mu, _s, gn, gu, gv, _gi, _g = wp.grad(first_guess_loss)(
            s, total, contacts.mu[c], S(code[3]), n, u, v, ba.impulse[c], g
        )
        ba.mu[c] = ba.mu[c] + g_mu
        add_mass(b, g_total, bodies, ba)
        oa = b
        if a >= 0:
            add_mass(a, g_total, bodies, ba)
            oa = a
        by = ByContact()
        by.ra = ba.ra[c]
        by.rb = ba.rb[c]
        by.normal = ba.normal[c] + gn
        by.u = ba.across_u[c] + gu
        by.v = ba.across_v[c] + gv
        by.weights = ba.weights[c]
        by.steps = ba.steps[c] + gs
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
        sweep_visits=sweep_visits,
        sweep_listed=sweep_listed,
        clear_contacts=clear_contacts,
    )
