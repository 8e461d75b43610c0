"""In which order the contacts of bodies are visited: from the table up, back down, then all.

Gauss-Seidel alone carries a load one body further in a pass, and lets a heavy body press a light
one aside, for a number of passes that grows with the tower's height squared and with the ratio of
the masses. So the passes start from a guess that is right for whatever stands. On the way up every
body is held by those below it as if they were scenery, which says where everything ends up. On the
way down each body takes the load of those above and is held again. Where the guess would add
energy, nothing stood, and the passes start from nothing.
Source: Guendelman, Bridson, Fedkiw, "Nonconvex Rigid Bodies with Stacking", 2003, section 7 (from
the ground up, as if what is below had infinite mass).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .body_contact import body_contact

__all__ = ["VISITS", "body_visits"]

HOLDS_ALONE = 6
"""Passes over the contacts that hold one body, at most, where no body stands on another one."""
HOLDS = 20
"""The same where one does: what one pass leaves, the bodies above it add up."""
PASSES = 60
"""Passes over all contacts, at most."""
LEVEL = 1.0e-5
"""Bodies whose heights differ by less go by their numbers [m]: side by side on the table, rounding
would sort them."""
EXACT = 1.0e-7
"""When no impulse of a pass moved its contact by more than this [m], the passes end."""
VISITS = 2 * (1 + HOLDS) + 1 + PASSES
"""Visits of a contact, at most."""


@functools.cache
def body_visits(scalar: Any, lanes: int, noted: bool = False) -> SimpleNamespace:
    """`solve_contacts(start, end, ...)` returns how many visits it made.

    Args:
        noted: whether they are on the log (see `body_contact`); if not, none are counted
    """
    t = structures(scalar, lanes)
    S, R3, Bodies, Contacts = t.S, t.R3, t.Bodies, t.Contacts
    contact = body_contact(scalar, lanes, noted)
    visit, share_load, react = contact.visit, contact.share_load, contact.react
    carries, relative = contact.carries, contact.relative

    @wp.func
    def before(c: int, d: int, bodies: Bodies, contacts: Contacts):
        """Whether contact c holds a lower body than contact d."""
        b = contacts.b[c]
        e = contacts.b[d]
        x = bodies.x[b]
        y = bodies.x[e]
        apart = y[2] - x[2]
        return apart > S(LEVEL) or (apart > -S(LEVEL) and b < e)

    @wp.func
    def sort_contacts(start: int, end: int, bodies: Bodies, contacts: Contacts):
        """Order of the contacts by the height of the bodies that they hold."""
        for c in range(start, end):
            k = int(c)
            while k > start and before(c, contacts.order[k - 1], bodies, contacts):
                contacts.order[k] = contacts.order[k - 1]
                k -= 1
            contacts.order[k] = c

    @wp.func
    def hold(first: int, last: int, most: int, at: int, bodies: Bodies, contacts: Contacts):
        """What holds one body, contacts first .. last in order; returns where the log ends."""
        at = share_load(first, last, at, bodies, contacts)
        p = int(0)
        while p < most:
            largest = S(0.0)
            for k in range(last - first):
                i = first + k
                if p % 2 == 1:
                    i = last - 1 - k
                c = contacts.order[i]
                if carries(c, contacts):
                    largest = wp.max(largest, visit(c, at, True, bodies, contacts))
                    if wp.static(noted):
                        at += 1
            p += 1
            if largest < S(EXACT):
                p = most
        return at

    @wp.func
    def is_last(k: int, step: int, start: int, end: int, contacts: Contacts):
        """Whether the contact at place k is the last of its upper body's, going by `step`."""
        last = k + step < start or k + step >= end
        if not last:
            last = contacts.b[contacts.order[k + step]] != contacts.b[contacts.order[k]]
        return last

    @wp.func
    def gained(start: int, end: int, bodies: Bodies, contacts: Contacts):
        """Kinetic energy that the impulses add, times dt^2 [J s^2]."""
        total = S(0.0)
        for c in range(start, end):
            f = contacts.impulse[c]
            s = contacts.steps[c]
            d = relative(c, bodies, contacts) * S(0.5)
            total += f[0] * (s[0] + wp.dot(d, contacts.normal[c]))
            total += f[1] * (s[1] + wp.dot(d, contacts.u[c]))
            total += f[2] * (s[2] + wp.dot(d, contacts.v[c]))
        return total

    @wp.func
    def forget(start: int, end: int, bodies: Bodies, contacts: Contacts):
        for c in range(start, end):
            contacts.impulse[c] = R3()
            a = contacts.a[c]
            b = contacts.b[c]
            bodies.dx[b] = R3()
            bodies.dr[b] = R3()
            if a >= 0:
                bodies.dx[a] = R3()
                bodies.dr[a] = R3()

    @wp.func
    def solve_contacts(start: int, end: int, bodies: Bodies, contacts: Contacts):
        base = start * wp.static(VISITS)
        at = int(base)
        count = end - start
        sort_contacts(start, end, bodies, contacts)
        stacked = bool(False)
        beside = bool(False)
        for c in range(start, end):
            if not carries(c, contacts):
                beside = True
            elif contacts.a[c] >= 0 and bodies.w[contacts.a[c]] > S(0.0):
                stacked = True
        # up from the table, and down to it again if a body stands on another one
        way = wp.where(stacked, 2 * count, count)
        most = wp.where(stacked, wp.static(HOLDS), wp.static(HOLDS_ALONE))
        begin = int(start)
        for r in range(way):
            k = start + r
            step = int(1)
            if r >= count:
                k = end - 1 - (r - count)
                step = -1
            if r == count:
                begin = end - 1
            if is_last(k, step, start, end, contacts):
                first = wp.min(begin, k)
                last = wp.max(begin, k) + 1
                if r < count or last < end:
                    at = hold(first, last, most, at, bodies, contacts)
                if r >= count:
                    for i in range(first, last):
                        c = contacts.order[i]
                        if carries(c, contacts) and contacts.a[c] >= 0:
                            react(c, at, bodies, contacts)
                            if wp.static(noted):
                                at += 1
                begin = k + step
        if stacked:
            if gained(start, end, bodies, contacts) > S(0.0):
                forget(start, end, bodies, contacts)
                at = base
        if stacked or beside:
            p = int(0)
            while p < wp.static(PASSES):
                largest = S(0.0)
                for k in range(count):
                    i = start + k
                    if p % 2 == 1:
                        i = end - 1 - k
                    largest = wp.max(largest, visit(contacts.order[i], at, False, bodies, contacts))
                    if wp.static(noted):
                        at += 1
                p += 1
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
        return at - base

    return SimpleNamespace(solve_contacts=solve_contacts)
