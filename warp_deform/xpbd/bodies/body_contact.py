"""Contacts of rigid bodies with each other and with the table: listed first, then solved together.

Projected Gauss-Seidel with accumulated impulses: a later pass may take back what an earlier one
gave too much, so the result hardly depends on the order of the corners, boxes rest without rocking,
and stacks stand. Within a substep the corrections are small, so they are linear in the impulses:
arms and inertia stay those of the predicted pose. Source: Catto, "Iterative Dynamics with Temporal
Coherence", 2005, with positional impulses as in Mueller et al., 2020.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .overlap_recovery import overlap_recovery
from .rigid_body import rigid_body

__all__ = ["AHEAD", "ALONE", "BOTH", "REACTION", "SHARED", "VISIT", "body_contact"]

STEEP = 0.5
"""Least vertical share of the normal with which one body rests on another."""
VISIT = 6
"""Scalars of `Contacts.log` for a visit."""
BOTH, ALONE, SHARED, REACTION = 0, 1, 2, 3
"""Kinds of visits: of both bodies, of the upper one alone, its shares, what the lower one takes."""
AHEAD = 1.0e-4
"""Points this far apart are listed: the solution itself may bring them together [m]."""


@functools.cache
def body_contact(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """What happens to one contact: `list_contact`, then visits of the kinds that `body_visits` asks
    for, between `begin_body` and `end_body` of every body.

    `relative` is how far the points of a contact have been moved against each other, which the
    adjoint asks, too.

    Args:
        noted: for the backward sweep, every visit is written to `Contacts.visit` and the impulses
            before it to `Contacts.log`
    """
    t = structures(scalar, lanes)
    S, R3, M33, Bodies, Contacts = t.S, t.R3, t.M33, t.Bodies, t.Contacts
    body = rigid_body(scalar, lanes)
    turned, moved = body.turned, body.moved
    remaining = overlap_recovery(scalar).remaining

    @wp.func
    def begin_body(b: int, bodies: Bodies):
        bodies.dx[b] = R3()
        bodies.dr[b] = R3()
        spread = M33()
        if bodies.w[b] > S(0.0):
            turn = wp.quat_to_matrix(bodies.q[b])
            spread = turn * bodies.inverse_inertia[b] * wp.transpose(turn)
        bodies.spread[b] = spread

    @wp.func
    def end_body(b: int, bodies: Bodies):
        bodies.x[b] = bodies.x[b] + bodies.dx[b]
        bodies.q[b] = turned(bodies.q[b], bodies.dr[b])

    @wp.func
    def carries(c: int, contacts: Contacts):
        """Whether the upper body of contact c rests on the lower one, rather than leans on it."""
        n = contacts.normal[c]
        w = contacts.upper[c]
        return n[2] > S(STEEP) and w[0] > S(0.0)

    @wp.func
    def note(at: int, c: int, how: int, old: R3, contacts: Contacts):
        contacts.visit[at] = wp.vec2i(c, how)
        for k in range(3):
            contacts.log[at * wp.static(VISIT) + k] = old[k]

    @wp.func
    def note_friction(at: int, fu: S, fv: S, contacts: Contacts):
        contacts.log[at * wp.static(VISIT) + 3] = fu
        contacts.log[at * wp.static(VISIT) + 4] = fv

    @wp.func
    def weights(b: int, r: R3, n: R3, u: R3, v: R3, bodies: Bodies):
        """Inverse masses that impulses along n, u and v at offset r meet [1/kg]."""
        rn = wp.cross(r, n)
        ru = wp.cross(r, u)
        rv = wp.cross(r, v)
        spread = bodies.spread[b]
        w = bodies.w[b]
        return R3(
            w + wp.dot(rn, spread * rn), w + wp.dot(ru, spread * ru), w + wp.dot(rv, spread * rv)
        )

    @wp.func
    def list_contact(
        c: int,
        a: int,
        b: int,
        pa: R3,
        pb: R3,
        n: R3,
        mu: S,
        max_recovery: S,
        bodies: Bodies,
        contacts: Contacts,
    ):
        """Contact c: point pb of body b stays ahead of point pa of body a (-1: the table) along n.

        A body that rests on another one is listed as `Contacts.b`. Of an overlap that the substep
        began with, a share is given back, at most `max_recovery`.
        """
        turned_over = a >= 0 and n[2] < -S(STEEP)
        lower = wp.where(turned_over, b, a)
        upper = wp.where(turned_over, a, b)
        low = wp.where(turned_over, pb, pa)
        high = wp.where(turned_over, pa, pb)
        up = wp.where(turned_over, -n, n)
        contacts.a[c] = lower
        contacts.b[c] = upper
        rb = high - bodies.x[upper]
        contacts.rb[c] = rb
        slip = moved(upper, bodies, wp.quat_rotate_inv(bodies.q[upper], rb))
        u = wp.normalize(wp.cross(up, R3(S(1.0), S(0.0), S(0.0))))
        if wp.abs(up[0]) > S(0.7):
            u = wp.normalize(wp.cross(up, R3(S(0.0), S(1.0), S(0.0))))
        v = wp.cross(up, u)
        w = weights(upper, rb, up, u, v, bodies)
        contacts.upper[c] = w
        if lower >= 0:
            ra = low - bodies.x[lower]
            contacts.ra[c] = ra
            slip -= moved(lower, bodies, wp.quat_rotate_inv(bodies.q[lower], ra))
            w += weights(lower, ra, up, u, v, bodies)
        contacts.weights[c] = w
        gap = wp.dot(high - low, up)
        before = gap - wp.dot(slip, up)
        contacts.normal[c] = up
        contacts.u[c] = u
        contacts.v[c] = v
        overlap = wp.max(-before, S(0.0))
        left = remaining(overlap, max_recovery)
        contacts.steps[c] = R3(gap + left, wp.dot(slip, u), wp.dot(slip, v))
        contacts.impulse[c] = R3()
        contacts.mu[c] = mu

    @wp.func
    def relative(c: int, bodies: Bodies, contacts: Contacts):
        """Correction of the points' relative position so far."""
        b = contacts.b[c]
        d = bodies.dx[b] + wp.cross(bodies.dr[b], contacts.rb[c])
        a = contacts.a[c]
        if a >= 0:
            d -= bodies.dx[a] + wp.cross(bodies.dr[a], contacts.ra[c])
        return d

    @wp.func
    def push_upper(c: int, impulse: R3, bodies: Bodies, contacts: Contacts):
        b = contacts.b[c]
        bodies.dx[b] = bodies.dx[b] + impulse * bodies.w[b]
        bodies.dr[b] = bodies.dr[b] + bodies.spread[b] * wp.cross(contacts.rb[c], impulse)

    @wp.func
    def push_lower(c: int, impulse: R3, bodies: Bodies, contacts: Contacts):
        a = contacts.a[c]
        if a >= 0:
            bodies.dx[a] = bodies.dx[a] - impulse * bodies.w[a]
            bodies.dr[a] = bodies.dr[a] - bodies.spread[a] * wp.cross(contacts.ra[c], impulse)

    @wp.func
    def visit(c: int, at: int, alone: bool, bodies: Bodies, contacts: Contacts):
        """One contact once; returns the largest step that it made [m].

        Args:
            alone: whether the lower body stays where it is
        """
        n = contacts.normal[c]
        u = contacts.u[c]
        v = contacts.v[c]
        w = contacts.weights[c]
        if alone:
            w = contacts.upper[c]
        s = contacts.steps[c]
        old = contacts.impulse[c]
        normal = wp.max(old[0] - (s[0] + wp.dot(relative(c, bodies, contacts), n)) / w[0], S(0.0))
        largest = wp.abs(normal - old[0]) * w[0]
        if wp.static(noted):
            note(at, c, wp.where(alone, wp.static(ALONE), wp.static(BOTH)), old, contacts)
        if normal > S(0.0) or old[0] > S(0.0):
            step = n * (normal - old[0])
            push_upper(c, step, bodies, contacts)
            if not alone:
                push_lower(c, step, bodies, contacts)
            # friction takes back the step across the normal as far as its budget goes
            d = relative(c, bodies, contacts)
            fu = old[1] - (s[1] + wp.dot(d, u)) / w[1]
            fv = old[2] - (s[2] + wp.dot(d, v)) / w[2]
            if wp.static(noted):
                note_friction(at, fu, fv, contacts)
            budget = contacts.mu[c] * normal
            f = wp.sqrt(fu * fu + fv * fv)
            if f > budget:
                fu = fu * (budget / f)
                fv = fv * (budget / f)
            step = u * (fu - old[1]) + v * (fv - old[2])
            push_upper(c, step, bodies, contacts)
            if not alone:
                push_lower(c, step, bodies, contacts)
            contacts.impulse[c] = R3(normal, fu, fv)
            across = wp.max(wp.abs(fu - old[1]) * w[1], wp.abs(fv - old[2]) * w[2])
            largest = wp.max(largest, across)
        return largest

    @wp.func
    def share_load(first: int, last: int, at: int, bodies: Bodies, contacts: Contacts):
        """Contacts first .. last of `Contacts.order`, which hold one body: each takes its share of
        what is left to hold, without turning anything, as under a box that rests or slides.
        """
        b = contacts.b[contacts.order[first]]
        loaded = S(0.0)
        for k in range(first, last):
            c = contacts.order[k]
            if carries(c, contacts):
                s = contacts.steps[c]
                old = contacts.impulse[c]
                left = s[0] + wp.dot(relative(c, bodies, contacts), contacts.normal[c])
                if left < S(0.0) or old[0] > S(0.0):
                    loaded += S(1.0)
        part = S(1.0) / (bodies.w[b] * wp.max(loaded, S(1.0)))
        dx = bodies.dx[b]
        dr = bodies.dr[b]
        for k in range(first, last):
            c = contacts.order[k]
            if carries(c, contacts):
                n = contacts.normal[c]
                u = contacts.u[c]
                v = contacts.v[c]
                s = contacts.steps[c]
                old = contacts.impulse[c]
                d = relative(c, bodies, contacts)
                normal = wp.max(old[0] - (s[0] + wp.dot(d, n)) * part, S(0.0))
                fu = old[1] - (s[1] + wp.dot(d, u)) * part
                fv = old[2] - (s[2] + wp.dot(d, v)) * part
                if wp.static(noted):
                    note(at, c, wp.static(SHARED), old, contacts)
                    note_friction(at, fu, fv, contacts)
                    contacts.log[at * wp.static(VISIT) + 5] = wp.max(loaded, S(1.0))
                    at += 1
                budget = contacts.mu[c] * normal
                f = wp.sqrt(fu * fu + fv * fv)
                if f > budget:
                    fu = fu * (budget / f)
                    fv = fv * (budget / f)
                new = R3(normal, fu, fv)
                contacts.impulse[c] = new
                step = n * (new[0] - old[0]) + u * (new[1] - old[1]) + v * (new[2] - old[2])
                dx += step * bodies.w[b]
                dr += bodies.spread[b] * wp.cross(contacts.rb[c], step)
        bodies.dx[b] = dx
        bodies.dr[b] = dr
        return at

    @wp.func
    def react(c: int, at: int, bodies: Bodies, contacts: Contacts):
        """The lower body of contact c takes the load that the upper one has met."""
        f = contacts.impulse[c]
        if wp.static(noted):
            note(at, c, wp.static(REACTION), f, contacts)
        push = contacts.normal[c] * f[0] + contacts.u[c] * f[1] + contacts.v[c] * f[2]
        push_lower(c, push, bodies, contacts)

    return SimpleNamespace(
        begin_body=begin_body,
        list_contact=list_contact,
        relative=relative,
        visit=visit,
        share_load=share_load,
        react=react,
        carries=carries,
        end_body=end_body,
    )
