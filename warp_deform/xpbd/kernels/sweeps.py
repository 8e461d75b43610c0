"""The phases of a substep taken back, in the opposite order of the forward kernel's.

Each pops from the tape what its forward phase left there, and returns the tops of the tape after
that and the derivatives by parameters, to which it has added.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...objects.attributes import SpringMode
from ...objects.push import MOST_PUSHES
from ..contact.edge_contact_adjoint import edge_contact_adjoint
from ..contact.sphere_contact import sphere_contact_adjoint
from ..contact.table_contact import table_contact_adjoint
from ..contact.triangle_contact_adjoint import triangle_contact_adjoint
from ..lanes.algebra import add, any_less, div, less, mul, select, sub  # noqa: F401
from ..lanes.sweep_state import sweep_state
from ..lanes.tape import GRIP_WORDS, TRIANGLE_SCALARS, TRIANGLE_WORDS, Kind, tape
from ..springs.bending import bending_adjoint
from ..springs.distance import distance_adjoint
from ..springs.internal_friction import internal_friction_adjoint
from ..springs.tether import tether_adjoint
from .grip import grip_adjoint

__all__ = ["sweeps"]


@functools.cache
def sweeps(
    scalar: Any, lanes: int, with_bodies: bool, with_sheets: bool, with_edges: bool
) -> SimpleNamespace:
    """The phases for a precision and a width, with the variants of `forward_kernel`."""
    t = sweep_state(scalar, lanes)
    S, V, V3, L = t.S, t.V, t.V3, t.L
    Span, Pace, By, Substep, Always = t.Span, t.Pace, t.By, t.Substep, t.Always
    Settings, Topology, Springs, Pairs = t.Settings, t.Topology, t.Springs, t.Pairs
    Particles, Sheets, Grips, Tape = t.Particles, t.Sheets, t.Grips, t.Tape
    Adjoint, BodyAdjoint = t.Adjoint, t.BodyAdjoint
    sweep_distance = distance_adjoint(scalar, lanes, with_sheets).sweep_distance
    sweep_bend = bending_adjoint(scalar, lanes).sweep_bend
    sweep_contact = sphere_contact_adjoint(scalar, lanes).sweep_contact
    table_ = table_contact_adjoint(scalar, lanes, with_sheets)
    sweep_finish, sweep_predict = table_.sweep_finish, table_.sweep_predict
    stepped = table_.stepped
    sweep_tether = tether_adjoint(scalar, lanes).sweep_tether
    sweep_triangle = triangle_contact_adjoint(scalar, lanes).sweep_triangle
    sweep_edge = edge_contact_adjoint(scalar, lanes).sweep_edge
    sweep_spring = internal_friction_adjoint(scalar, lanes).sweep_spring
    sweep_grip = grip_adjoint(scalar, lanes, with_bodies).sweep_grip
    KINDS = len(Kind)
    BYTES = 3 * lanes * (4 if scalar is wp.float32 else 8)
    fetch_ahead = tape(scalar, lanes).fetch_ahead

    @wp.func
    def count(kind: int, on: V, amount: int, adj: Adjoint):
        adj.fired[kind] = adj.fired[kind] + on * S(amount)

    @wp.func
    def look_ahead(at: Span, springs: Springs, grips: Grips):
        always = Always()
        bends = int(0)
        stretches = int(0)
        damped = int(0)
        for s in range(at.s0, at.s1):
            if springs.mode[s] == wp.static(int(SpringMode.BEND)):
                bends += 1
            elif springs.mode[s] == wp.static(int(SpringMode.EQUAL)):
                stretches += 1
            if springs.limit[s] > S(0.0):
                damped += 1
        longest = int(0)
        for p in range(wp.static(L * MOST_PUSHES)):
            push = at.w0 * wp.static(MOST_PUSHES) + p
            if grips.push[push] >= 0:
                longest = wp.max(longest, grips.push_steps[push])
        always.bends = bends
        always.stretches = stretches
        always.damped = damped
        always.longest_push = longest
        return always

    @wp.func
    def open_substep(
        at: Span, always: Always, number: int, ahead: int, tops: wp.vec4i, tape: Tape, adj: Adjoint
    ):
        now = Substep()
        tops[1] -= 4
        now.on = tape.v[tops[1]]
        now.fastest = tape.v[tops[1] + 1]
        now.holding = tape.v[tops[1] + 2]
        now.sleep = tape.v[tops[1] + 3]
        now.number = number
        now.ahead = ahead
        now.counts = at.g * wp.static(KINDS)
        count(now.counts + wp.static(int(Kind.STRETCH)), now.on, always.stretches, adj)
        count(now.counts + wp.static(int(Kind.BEND)), now.on, always.bends, adj)
        return now, tops

    @wp.func
    def sweep_viscosity(
        at: Span, st: Settings, now: Substep, always: Always, tops: wp.vec4i, springs: Springs,
        tape: Tape, adj: Adjoint,
    ):  # fmt: skip
        if st.viscous > S(0.0):
            count(now.counts + wp.static(int(Kind.VISCOSITY)), now.on, always.damped, adj)
            for r in range(at.s1 - at.s0):
                s = at.s1 - 1 - r
                if springs.limit[s] > S(0.0):
                    tops[0] -= 1
                    sweep_spring(s, at.p0, tape.x[tops[0]], st.viscous, now.on, springs, adj)
        return tops

    @wp.func
    def sweep_finishes(
        at: Span, pace: Pace, now: Substep, again: bool, by: By, tops: wp.vec4i, st: Settings,
        top: Topology, tape: Tape, adj: Adjoint,
    ):  # fmt: skip
        zero = V(S(0.0))
        n = at.particles
        all_on = not any_less(now.on, S(0.5))
        if wp.static(with_sheets):
            tops[0] -= 3 * n
        else:
            tops[0] -= n
            tops[1] -= n
        tx = tops[0]
        tv = tops[1]
        by_table = by.table
        by_kept = by.kept
        for i in range(n):
            d = tape.x[tx]
            z = zero
            sleep = zero
            if wp.static(with_sheets):
                fetch_ahead(tape.x, tx + 3 * i - now.ahead, wp.static(3 * BYTES))
                x = tape.x[tx + 3 * i]
                d = stepped(
                    x, tape.x[tx + 3 * i + 1], adj.w[at.p0 + i], tape.x[tx + 3 * i + 2],
                    pace.share, pace.fall,
                )  # fmt: skip
                z = x.z
                sleep = now.sleep
            else:
                fetch_ahead(tape.x, tx + i - now.ahead, wp.static(BYTES))
                d = tape.x[tx + i]
                z = tape.v[tv + i]
            by_mu, by_share = sweep_finish(
                at.p0 + i, d, z, top.radius[at.radii + i], pace.inverse_dt, pace.table_mu,
                now.fastest, now.on, all_on, again, pace.dt, pace.kept, pace.fall, st.dry, sleep,
                now.counts, adj,
            )  # fmt: skip
            by_table = by_table + by_mu
            by_kept = by_kept + by_share
        by.table = by_table
        by.kept = by_kept
        return by, tops

    @wp.func
    def sweep_fabrics(
        at: Span, pace: Pace, now: Substep, by: By, tops: wp.vec4i, sheets: Sheets, tape: Tape,
        adj: Adjoint,
    ):  # fmt: skip
        tk = int(tops[2])
        ts = int(tops[3])
        by_contact = by.contact
        if at.triangles > 0:
            for r in range(wp.static(L)):
                lane = wp.static(L) - 1 - r
                if now.on[lane] > S(0.0):
                    if wp.static(with_edges):
                        tk -= 1
                        for _ in range(tape.k[tk]):
                            tk -= wp.static(TRIANGLE_WORDS)
                            ts -= wp.static(TRIANGLE_SCALARS)
                            sweep_edge(
                                tk, ts, now.finished, lane, at.p0, pace.push, now.counts, sheets,
                                tape, adj,
                            )  # fmt: skip
                    tk -= 1
                    for _ in range(tape.k[tk]):
                        tk -= wp.static(TRIANGLE_WORDS)
                        ts -= wp.static(TRIANGLE_SCALARS)
                        by_contact[lane] = by_contact[lane] + sweep_triangle(
                            tk, ts, now.finished, lane, at.p0, pace.contact_mu[lane], pace.push,
                            now.counts, sheets, tape, adj,
                        )  # fmt: skip
        by.contact = by_contact
        tops[2] = tk
        tops[3] = ts
        return by, tops

    @wp.func
    def sweep_contacts(
        at: Span, pace: Pace, now: Substep, by: By, tops: wp.vec4i, pairs: Pairs, tape: Tape,
        adj: Adjoint,
    ):  # fmt: skip
        tx = int(tops[0])
        tv = int(tops[1])
        tk = int(tops[2])
        by_contact = by.contact
        tk -= 1
        for _ in range(tape.k[tk]):
            tk -= 1
            tv -= 1
            tx -= 2
            fetch_ahead(tape.x, tx - now.ahead, wp.static(2 * BYTES))
            by_contact = by_contact + sweep_contact(
                tape.k[tk], at.p0, tape.x[tx], tape.x[tx + 1], tape.v[tv], pace.contact_mu,
                pace.push, pairs, now.counts, now.on, adj,
            )  # fmt: skip
        by.contact = by_contact
        return by, wp.vec4i(tx, tv, tk, tops[3])

    @wp.func
    def sweep_tethers(
        at: Span, now: Substep, tops: wp.vec4i, q: Particles, tape: Tape, adj: Adjoint
    ):
        zero = V(S(0.0))
        tx = int(tops[0])
        tk = int(tops[2])
        if any_less(zero - now.holding, S(0.0)):
            tk -= wp.static(L)
            held = int(tk)
            tk -= 1
            by_held = V3(zero, zero, zero)
            for _ in range(tape.k[tk]):
                tk -= 1
                tx -= 1
                by_held = by_held + sweep_tether(
                    at.p0 + tape.k[tk], tape.x[tx], now.holding, now.counts, now.on, q, adj
                )
            for lane in range(wp.static(L)):
                if tape.k[held + lane] >= 0:
                    i = at.p0 + tape.k[held + lane]
                    gx = adj.x[i]
                    gx.x[lane] = gx.x[lane] + by_held.x[lane]
                    gx.y[lane] = gx.y[lane] + by_held.y[lane]
                    gx.z[lane] = gx.z[lane] + by_held.z[lane]
                    adj.x[i] = gx
        return wp.vec4i(tx, tops[1], tk, tops[3])

    @wp.func
    def sweep_springs(
        at: Span, pace: Pace, now: Substep, by: By, tops: wp.vec4i, springs: Springs, tape: Tape,
        adj: Adjoint,
    ):  # fmt: skip
        tx = int(tops[0])
        tk = int(tops[2])
        by_inverse_dt2 = by.inverse_dt2
        tk -= 1
        left = tape.k[tk]
        for r in range(at.s1 - at.s0):
            s = at.s1 - 1 - r
            mode = springs.mode[s]
            if mode == wp.static(int(SpringMode.BEND)):
                tx -= 1
                by_inverse_dt2 = by_inverse_dt2 + sweep_bend(
                    s, at.p0, tape.x[tx], pace.inverse_dt2, springs, adj
                )
            else:
                acted = mode == wp.static(int(SpringMode.EQUAL))
                if not acted and left > 0:
                    if tape.k[tk - 1] == s:
                        acted = True
                        tk -= 1
                        left -= 1
                if acted:
                    tx -= 1
                    fetch_ahead(tape.x, tx - now.ahead, wp.static(BYTES))
                    by_inverse_dt2 = by_inverse_dt2 + sweep_distance(
                        s, at.p0, tape.x[tx], pace.inverse_dt2, springs, now.counts, now.on, adj
                    )
        by.inverse_dt2 = by_inverse_dt2
        return by, wp.vec4i(tx, tops[1], tk, tops[3])

    @wp.func
    def sweep_grips(
        at: Span, pace: Pace, tops: wp.vec4i, grips: Grips, tape: Tape, adj: Adjoint,
        ba: BodyAdjoint,
    ):  # fmt: skip
        counts = at.g * wp.static(KINDS)
        tops[2] -= 1
        for _ in range(tape.k[tops[2]]):
            tops[2] -= wp.static(GRIP_WORDS)
            sweep_grip(
                tops[2], at.w0, at.p0, at.b0, at.bodies, pace.dt, counts, grips, tape, adj, ba
            )
        return tops

    @wp.func
    def sweep_pushes(at: Span, pace: Pace, now: Substep, by: By, grips: Grips, adj: Adjoint):
        by_kept = by.kept
        for p in range(wp.static(L * MOST_PUSHES)):
            lane = p // wp.static(MOST_PUSHES)
            push = at.w0 * wp.static(MOST_PUSHES) + p
            i = grips.push[push]
            if i >= 0 and now.number < grips.push_steps[push] and now.on[lane] > S(0.0):
                gx = adj.x[at.p0 + i]
                kick = grips.push_acceleration[push] * (pace.dt * pace.dt)
                by_kept[lane] = by_kept[lane] + (
                    gx.x[lane] * kick[0] + gx.y[lane] * kick[1] + gx.z[lane] * kick[2]
                )
        by.kept = by_kept
        return by

    @wp.func
    def sweep_predictions(
        at: Span, pace: Pace, first: int, stride: int, by: By, tape: Tape, adj: Adjoint
    ):
        by_kept = by.kept
        for i in range(at.particles):
            by_kept = by_kept + sweep_predict(
                at.p0 + i, tape.x[first + stride * i], pace.dt, pace.kept, pace.fall, adj
            )
        by.kept = by_kept
        return by

    return SimpleNamespace(
        **vars(t), look_ahead=look_ahead, open_substep=open_substep,
        sweep_viscosity=sweep_viscosity, sweep_finishes=sweep_finishes,
        sweep_fabrics=sweep_fabrics, sweep_contacts=sweep_contacts, sweep_tethers=sweep_tethers,
        sweep_springs=sweep_springs, sweep_grips=sweep_grips, sweep_pushes=sweep_pushes,
        sweep_predictions=sweep_predictions,
    )  # fmt: skip
