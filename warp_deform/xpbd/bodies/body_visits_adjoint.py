"""Adjoint of the visits of contacts of bodies, see `body_visits`.

Corrections are undone one by one from the last visit on the log, so every visit finds the state
that it met.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind
from .body_contact import ALONE, REACTION, SHARED, VISIT, body_contact

__all__ = ["body_visits_adjoint"]


@functools.cache
def body_visits_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_visits(first, last, ...)` takes visits first .. last of the log back; `count_contacts`
    counts what acts after the last; `add_mass` adds to the derivative by an inverse mass.

    Branches: an impulse at 0, friction at its budget, how many contacts share a load, the order of
    the contacts, whether the guess adds energy, and after which pass they end.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Bodies, Contacts, BodyAdjoint, Adjoint = t.Bodies, t.Contacts, t.BodyAdjoint, t.Adjoint
    count_one = lane_access(scalar, lanes).count_one
    relative = body_contact(scalar, lanes, True).relative

    @wp.func
    def add_mass(b: int, g: S, bodies: Bodies, ba: BodyAdjoint):
        """Derivative by inverse mass; a held body's is 0 whatever it is when free."""
        if bodies.w[b] > S(0.0):
            ba.w[b] = ba.w[b] + g

    @wp.func
    def sweep_push(b: int, r: R3, impulse: R3, bodies: Bodies, ba: BodyAdjoint):
        """One body that is pushed: derivatives by its inverse masses; returns those by impulse."""
        gx = ba.dx[b]
        gr = ba.dr[b]
        add_mass(b, wp.dot(gx, impulse), bodies, ba)
        ba.spread[b] = ba.spread[b] + wp.outer(gr, wp.cross(r, impulse))
        return gx * bodies.w[b] + wp.cross(bodies.spread[b] * gr, r)

    @wp.func
    def sweep_upper(c: int, impulse: R3, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        """Takes `push_upper` back; returns the derivatives by the impulse."""
        b = contacts.b[c]
        rb = contacts.rb[c]
        g = sweep_push(b, rb, impulse, bodies, ba)
        ba.rb[c] = ba.rb[c] + wp.cross(impulse, bodies.spread[b] * ba.dr[b])
        bodies.dx[b] = bodies.dx[b] - impulse * bodies.w[b]
        bodies.dr[b] = bodies.dr[b] - bodies.spread[b] * wp.cross(rb, impulse)
        return g

    @wp.func
    def sweep_lower(c: int, impulse: R3, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        """The same for `push_lower`."""
        g = R3()
        a = contacts.a[c]
        if a >= 0:
            ra = contacts.ra[c]
            g -= sweep_push(a, ra, -impulse, bodies, ba)
            ba.ra[c] = ba.ra[c] - wp.cross(impulse, bodies.spread[a] * ba.dr[a])
            bodies.dx[a] = bodies.dx[a] + impulse * bodies.w[a]
            bodies.dr[a] = bodies.dr[a] + bodies.spread[a] * wp.cross(ra, impulse)
        return g

    @wp.func
    def sweep_step(
        c: int, alone: bool, impulse: R3, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint
    ):
        g = sweep_upper(c, impulse, bodies, contacts, ba)
        if not alone:
            g += sweep_lower(c, impulse, bodies, contacts, ba)
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
    def old_impulse(at: int, contacts: Contacts):
        return R3(contacts.log[at], contacts.log[at + 1], contacts.log[at + 2])

    @wp.func
    def sweep_cone(c: int, at: int, normal: S, g: R3, contacts: Contacts, ba: BodyAdjoint):
        """From derivatives by an impulse to those by friction before its limit."""
        fu = contacts.log[at + 3]
        fv = contacts.log[at + 4]
        budget = contacts.mu[c] * normal
        f = wp.sqrt(fu * fu + fv * fv)
        back = R3(g[0], g[1], g[2])
        if f > budget:
            g_budget = (fu * g[1] + fv * g[2]) / f
            turn = g_budget / f
            ba.mu[c] = ba.mu[c] + g_budget * normal
            back = R3(
                g[0] + g_budget * contacts.mu[c],
                (g[1] - fu * turn) * (budget / f),
                (g[2] - fv * turn) * (budget / f),
            )
        return back

    @wp.func
    def add_axes(c: int, by_n: R3, by_u: R3, by_v: R3, ba: BodyAdjoint):
        ba.normal[c] = ba.normal[c] + by_n
        ba.across_u[c] = ba.across_u[c] + by_u
        ba.across_v[c] = ba.across_v[c] + by_v

    @wp.func
    def sweep_visit(
        c: int, at: int, alone: bool, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint
    ):
        new = contacts.impulse[c]
        old = old_impulse(at, contacts)
        if new[0] > S(0.0) or old[0] > S(0.0):
            n = contacts.normal[c]
            u = contacts.u[c]
            v = contacts.v[c]
            w = contacts.weights[c]
            if alone:
                w = contacts.upper[c]
            # the step across
            su = new[1] - old[1]
            sv = new[2] - old[2]
            g = sweep_step(c, alone, u * su + v * sv, bodies, contacts, ba)
            gu = wp.dot(g, u)
            gv = wp.dot(g, v)
            gf = sweep_cone(c, at, new[0], ba.impulse[c] + R3(S(0.0), gu, gv), contacts, ba)
            hu = gf[1] / w[1]
            hv = gf[2] / w[2]
            d = relative(c, bodies, contacts)
            by_u = g * su - d * hu
            by_v = g * sv - d * hv
            sweep_relative(c, -(u * hu + v * hv), bodies, contacts, ba)
            # the step along the normal
            step = new[0] - old[0]
            g = sweep_step(c, alone, n * step, bodies, contacts, ba)
            gn = wp.dot(g, n)
            by_n = g * step
            g_normal = gf[0] + gn
            if new[0] <= S(0.0):
                g_normal = S(0.0)
            hn = g_normal / w[0]
            d = relative(c, bodies, contacts)
            by_n -= d * hn
            sweep_relative(c, -n * hn, bodies, contacts, ba)
            ba.impulse[c] = R3(g_normal - gn, gf[1] - gu, gf[2] - gv)
            ba.steps[c] = ba.steps[c] - R3(hn, hu, hv)
            gw = R3(
                -hn * step,
                hu * (old[1] - contacts.log[at + 3]),
                hv * (old[2] - contacts.log[at + 4]),
            )
            if alone:
                ba.upper[c] = ba.upper[c] + gw
            else:
                ba.weights[c] = ba.weights[c] + gw
            add_axes(c, by_n, by_u, by_v, ba)
        contacts.impulse[c] = old

    @wp.func
    def sweep_reaction(c: int, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        f = contacts.impulse[c]
        n = contacts.normal[c]
        u = contacts.u[c]
        v = contacts.v[c]
        g = sweep_lower(c, n * f[0] + u * f[1] + v * f[2], bodies, contacts, ba)
        ba.impulse[c] = ba.impulse[c] + R3(wp.dot(g, n), wp.dot(g, u), wp.dot(g, v))
        add_axes(c, g * f[0], g * f[1], g * f[2], ba)

    @wp.func
    def sweep_shares(first: int, last: int, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        """Visits first .. last, in which contacts took their shares of one body's load."""
        for r in range(last - first):
            i = last - 1 - r
            who = contacts.visit[i]
            c = who[0]
            at = i * wp.static(VISIT)
            n = contacts.normal[c]
            u = contacts.u[c]
            v = contacts.v[c]
            w = bodies.w[contacts.b[c]]
            new = contacts.impulse[c]
            old = old_impulse(at, contacts)
            s = new - old
            g = sweep_upper(c, n * s[0] + u * s[1] + v * s[2], bodies, contacts, ba)
            add_axes(c, g * s[0], g * s[1], g * s[2], ba)
            by = R3(wp.dot(g, n), wp.dot(g, u), wp.dot(g, v))
            gf = R3()
            if new[0] > S(0.0):
                gf = sweep_cone(c, at, new[0], ba.impulse[c] + by, contacts, ba)
            way = R3(new[0] - old[0], contacts.log[at + 3] - old[1], contacts.log[at + 4] - old[2])
            add_mass(contacts.b[c], -wp.dot(gf, way) / w, bodies, ba)
            ba.impulse[c] = gf - by
            contacts.impulse[c] = old
            part = S(1.0) / (w * contacts.log[at + 5])
            for k in range(3):
                contacts.log[at + k] = gf[k] * part
        # the body is again where every share was reckoned
        for i in range(first, last):
            who = contacts.visit[i]
            c = who[0]
            h = old_impulse(i * wp.static(VISIT), contacts)
            d = relative(c, bodies, contacts)
            ba.steps[c] = ba.steps[c] - h
            add_axes(c, -d * h[0], -d * h[1], -d * h[2], ba)
            push = contacts.normal[c] * h[0] + contacts.u[c] * h[1] + contacts.v[c] * h[2]
            sweep_relative(c, -push, bodies, contacts, ba)

    @wp.func
    def count_contacts(
        start: int, end: int, lane: int, counts: int, contacts: Contacts, adj: Adjoint
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

    @wp.func
    def sweep_visits(first: int, last: int, bodies: Bodies, contacts: Contacts, ba: BodyAdjoint):
        """Visits first .. last of the log, backwards."""
        i = int(last)
        while i > first:
            i -= 1
            who = contacts.visit[i]
            if who[1] == wp.static(SHARED):
                end = i + 1
                while i > first and contacts.visit[i - 1][1] == wp.static(SHARED):
                    i -= 1
                sweep_shares(i, end, bodies, contacts, ba)
            elif who[1] == wp.static(REACTION):
                sweep_reaction(who[0], bodies, contacts, ba)
            else:
                alone = who[1] == wp.static(ALONE)
                sweep_visit(who[0], i * wp.static(VISIT), alone, bodies, contacts, ba)

    return SimpleNamespace(
        sweep_visits=sweep_visits, count_contacts=count_contacts, add_mass=add_mass
    )
