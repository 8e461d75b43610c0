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
from .rigid_body import rigid_body

__all__ = ["AHEAD", "GIVEN_BACK", "PASSES", "VISIT", "body_contact"]

PASSES = 6
"""Passes over the contacts at most."""
EXACT = 1.0e-7
"""When no impulse of a pass moved its contact by more than this [m], the passes end."""
GIVEN_BACK = 0.2
"""Share of an overlap that a substep undoes: all at once, it would become speed and rock the
box."""
VISIT = 5
"""Scalars of `Contacts.log` for a visit."""
AHEAD = 1.0e-4
"""Points this far apart are listed: the solution itself may bring them together [m]."""


@functools.cache
def body_contact(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """`begin_body`, `list_contact` for every pair of points, `solve_contacts`, `end_body`.

    `share_load` follows the listing of one pair of bodies. `relative` is how far the points of a
    contact have been moved against each other, which the adjoint asks, too.

    Args:
        noted: for the backward sweep, impulses before every visit are written to `Contacts.log`,
            and how many contacts share a load to `Contacts.code`; `solve_contacts` returns its
            passes
    """
    t = structures(scalar, lanes)
    S, R3, M33, Bodies, Contacts = t.S, t.R3, t.M33, t.Bodies, t.Contacts
    body = rigid_body(scalar, lanes)
    turned, moved = body.turned, body.moved

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
    def weight(b: int, r: R3, n: R3, bodies: Bodies):
        """Inverse mass that an impulse along the unit vector n at offset r meets [1/kg]."""
        rn = wp.cross(r, n)
        return bodies.w[b] + wp.dot(rn, bodies.spread[b] * rn)

    @wp.func
    def pair_weight(c: int, n: R3, bodies: Bodies, contacts: Contacts):
        w = weight(contacts.b[c], contacts.rb[c], n, bodies)
        if contacts.a[c] >= 0:
            w += weight(contacts.a[c], contacts.ra[c], n, bodies)
        return w

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

        Of an overlap that the substep began with, a share is given back, at most `max_recovery`.
        """
        contacts.a[c] = a
        contacts.b[c] = b
        rb = pb - bodies.x[b]
        contacts.rb[c] = rb
        slip = moved(b, bodies, wp.quat_rotate_inv(bodies.q[b], rb))
        if a >= 0:
            ra = pa - bodies.x[a]
            contacts.ra[c] = ra
            slip -= moved(a, bodies, wp.quat_rotate_inv(bodies.q[a], ra))
        u = wp.normalize(wp.cross(n, R3(S(1.0), S(0.0), S(0.0))))
        if wp.abs(n[0]) > S(0.7):
            u = wp.normalize(wp.cross(n, R3(S(0.0), S(1.0), S(0.0))))
        v = wp.cross(n, u)
        gap = wp.dot(pb - pa, n)
        before = gap - wp.dot(slip, n)
        contacts.normal[c] = n
        contacts.u[c] = u
        contacts.v[c] = v
        contacts.weights[c] = R3(
            pair_weight(c, n, bodies, contacts),
            pair_weight(c, u, bodies, contacts),
            pair_weight(c, v, bodies, contacts),
        )
        overlap = wp.max(-before, S(0.0))
        remaining = wp.max(overlap - max_recovery, overlap * S(1.0 - GIVEN_BACK))
        contacts.steps[c] = R3(gap + remaining, wp.dot(slip, u), wp.dot(slip, v))
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
    def apply(c: int, impulse: R3, bodies: Bodies, contacts: Contacts):
        b = contacts.b[c]
        bodies.dx[b] = bodies.dx[b] + impulse * bodies.w[b]
        bodies.dr[b] = bodies.dr[b] + bodies.spread[b] * wp.cross(contacts.rb[c], impulse)
        a = contacts.a[c]
        if a >= 0:
            bodies.dx[a] = bodies.dx[a] - impulse * bodies.w[a]
            bodies.dr[a] = bodies.dr[a] - bodies.spread[a] * wp.cross(contacts.ra[c], impulse)

    @wp.func
    def share_load(start: int, end: int, bodies: Bodies, contacts: Contacts):
        """First guess for the contacts start .. end of one pair of bodies: each carries its share
        without turning anything, as under a box that rests or slides.
        """
        loaded = S(0.0)
        for c in range(start, end):
            s = contacts.steps[c]
            if s[0] < S(0.0):
                loaded += S(1.0)
        for c in range(start, end):
            total = bodies.w[contacts.b[c]]
            if contacts.a[c] >= 0:
                total += bodies.w[contacts.a[c]]
            part = S(1.0) / (total * wp.max(loaded, S(1.0)))
            s = contacts.steps[c]
            normal = wp.max(-s[0], S(0.0)) * part
            fu = -s[1] * part
            fv = -s[2] * part
            f = wp.sqrt(fu * fu + fv * fv)
            share = wp.min(contacts.mu[c] * normal / wp.max(f, S(1.0e-30)), S(1.0))
            if wp.static(noted):
                code = contacts.code[c]
                code[3] = wp.max(int(loaded), 1)
                contacts.code[c] = code
            contacts.impulse[c] = R3(normal, fu * share, fv * share)
            across = contacts.u[c] * (fu * share) + contacts.v[c] * (fv * share)
            apply(c, contacts.normal[c] * normal + across, bodies, contacts)

    @wp.func
    def solve_contact(c: int, at: int, bodies: Bodies, contacts: Contacts):
        """One contact once; returns the largest step that it made [m]."""
        n = contacts.normal[c]
        u = contacts.u[c]
        v = contacts.v[c]
        w = contacts.weights[c]
        s = contacts.steps[c]
        old = contacts.impulse[c]
        if wp.static(noted):
            for k in range(3):
                contacts.log[at + k] = old[k]
        normal = wp.max(old[0] - (s[0] + wp.dot(relative(c, bodies, contacts), n)) / w[0], S(0.0))
        largest = wp.abs(normal - old[0]) * w[0]
        if normal > S(0.0) or old[0] > S(0.0):
            apply(c, n * (normal - old[0]), bodies, contacts)
            # friction takes back the step across the normal as far as its budget goes
            d = relative(c, bodies, contacts)
            fu = old[1] - (s[1] + wp.dot(d, u)) / w[1]
            fv = old[2] - (s[2] + wp.dot(d, v)) / w[2]
            if wp.static(noted):
                contacts.log[at + 3] = fu
                contacts.log[at + 4] = fv
            budget = contacts.mu[c] * normal
            f = wp.sqrt(fu * fu + fv * fv)
            if f > budget:
                fu = fu * (budget / f)
                fv = fv * (budget / f)
            apply(c, u * (fu - old[1]) + v * (fv - old[2]), bodies, contacts)
            contacts.impulse[c] = R3(normal, fu, fv)
            across = wp.max(wp.abs(fu - old[1]) * w[1], wp.abs(fv - old[2]) * w[2])
            largest = wp.max(largest, across)
        return largest

    @wp.func
    def solve_contacts(start: int, end: int, bodies: Bodies, contacts: Contacts):
        """Solve contacts start .. end, forwards and backwards in turn."""
        p = int(0)
        done = int(0)
        at = start * wp.static(PASSES * VISIT)
        while p < wp.static(PASSES):
            largest = S(0.0)
            for k in range(end - start):
                c = start + k
                if p % 2 == 1:
                    c = end - 1 - k
                largest = wp.max(largest, solve_contact(c, at, bodies, contacts))
                if wp.static(noted):
                    at += wp.static(VISIT)
            p += 1
            done = p
            if largest < S(EXACT):
                p = wp.static(PASSES)
        for c in range(start, end):
            impulse = contacts.impulse[c]
            if impulse[0] > S(0.0):
                a = contacts.a[c]
                b = contacts.b[c]
                bodies.support[b] = bodies.support[b] + 1
                if a >= 0:
                    bodies.support[a] = bodies.support[a] + 1
                    bodies.touching[a] = bodies.touching[a] + 1
                    bodies.touching[b] = bodies.touching[b] + 1
        return done

    return SimpleNamespace(
        begin_body=begin_body,
        list_contact=list_contact,
        share_load=share_load,
        relative=relative,
        solve_contacts=solve_contacts,
        end_body=end_body,
    )
