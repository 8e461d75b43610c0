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
from ..contact.sphere_contact import sphere_contact_adjoint
from ..contact.table_contact import table_contact_adjoint
from ..lanes.algebra import add, any_less, div, less, mul, select, sub  # noqa: F401
from ..lanes.lane_access import lane_access
from ..lanes.sweep_state import sweep_state
from ..lanes.tape import GRIP_WORDS, Kind, tape
from ..springs.beam import beam_adjoint
from ..springs.bending import bending_adjoint
from ..springs.chain import chain_adjoint
from ..springs.distance import distance_adjoint
from .grip_adjoint import grip_adjoint

__all__ = ["adjoint_phases"]


@functools.cache
def adjoint_phases(
    scalar: Any, lanes: int, with_bodies: bool, with_sheets: bool, with_lines: bool
) -> SimpleNamespace:
    """The phases for a precision and a width, with the variants of `forward_kernel`."""
    t = sweep_state(scalar, lanes)
    S, V, L = t.S, t.V, t.L
    Span, Pace, By, Substep, Always = t.Span, t.Pace, t.By, t.Substep, t.Always
    Topology, Pairs = t.Topology, t.Pairs
    Springs, Lines = t.Springs, t.Lines
    Grips, Tape, Adjoint, BodyAdjoint = t.Grips, t.Tape, t.Adjoint, t.BodyAdjoint
    sweep_distance = distance_adjoint(scalar, lanes, with_sheets).sweep_distance
    sweep_bend = bending_adjoint(scalar, lanes).sweep_bend
    sweep_chain = chain_adjoint(scalar, lanes).sweep_chain
    sweep_beam = beam_adjoint(scalar, lanes).sweep_beam
    sweep_contact = sphere_contact_adjoint(scalar, lanes).sweep_contact
    table_ = table_contact_adjoint(scalar, lanes, with_sheets)
    sweep_finish, sweep_predict = table_.sweep_finish, table_.sweep_predict
    stepped = table_.stepped
    sweep_grip = grip_adjoint(scalar, lanes, with_bodies).sweep_grip
    KINDS = len(Kind)
    BYTES = 3 * lanes * (4 if scalar is wp.float32 else 8)
    fetch_ahead = tape(scalar, lanes).fetch_ahead
    count_lanes = lane_access(scalar, lanes).count_lanes

    @wp.func
    def look_ahead(at: Span, top: Topology, springs: Springs, grips: Grips):
        always = Always()
        bends = int(0)
        stretches = int(0)
        for s in range(at.s0, at.s1):
            mode = springs.mode[s]
            if mode == wp.static(int(SpringMode.BEND)) or mode == wp.static(int(SpringMode.BEAM)):
                bends += 1
            elif mode == wp.static(int(SpringMode.EQUAL)):
                stretches += 1
            elif mode == wp.static(int(SpringMode.CHAIN)):
                stretches += 1
        longest = int(0)
        for p in range(wp.static(L * MOST_PUSHES)):
            slot = at.world0 * wp.static(MOST_PUSHES) + p
            if grips.push[slot] >= 0:
                longest = wp.max(longest, grips.push_steps[slot])
        always.bends = bends * at.passes
        always.stretches = stretches * at.passes
        pieces = top.piece_start[at.k]
        last = top.piece_start[at.k + 1]
        always.damped = springs.neighbour_first[last] - springs.neighbour_first[pieces]
        always.longest_push = longest
        return always

    @wp.func
    def open_substep(
        at: Span, always: Always, number: int, ahead: int, tops: wp.vec4i, tape: Tape, adj: Adjoint
    ):
        now = Substep()
        tops[1] -= 3
        now.on = tape.v[tops[1]]
        now.fastest = tape.v[tops[1] + 1]
        now.holding = tape.v[tops[1] + 2]
        now.number = number
        now.ahead = ahead
        now.counts = at.g * wp.static(KINDS)
        count_lanes(now.counts + wp.static(int(Kind.STRETCH)), now.on, always.stretches, adj)
        count_lanes(now.counts + wp.static(int(Kind.BEND)), now.on, always.bends, adj)
        return now, tops

    @wp.func
    def sweep_finishes(
        at: Span,
        pace: Pace,
        now: Substep,
        again: bool,
        by: By,
        tops: wp.vec4i,
        top: Topology,
        tape: Tape,
        adj: Adjoint,
    ):
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
        by_damping = by.damping_factor
        for i in range(n):
            d = tape.x[tx]
            z = zero
            if wp.static(with_sheets):
                fetch_ahead(tape.x, tx + 3 * i - now.ahead, wp.static(3 * BYTES))
                x = tape.x[tx + 3 * i]
                d = stepped(
                    x,
                    tape.x[tx + 3 * i + 1],
                    adj.w[at.p0 + i],
                    tape.x[tx + 3 * i + 2],
                    pace.damped_dt,
                    pace.fall,
                )
                z = x.z
            else:
                fetch_ahead(tape.x, tx + i - now.ahead, wp.static(BYTES))
                d = tape.x[tx + i]
                z = tape.v[tv + i]
            by_mu, by_share = sweep_finish(
                at.p0 + i,
                d,
                z,
                top.radius[at.radii + i],
                pace.inverse_dt,
                pace.table_mu,
                now.fastest,
                now.on,
                all_on,
                again,
                pace.dt,
                pace.damping_factor,
                pace.fall,
                now.counts,
                adj,
            )
            by_table = by_table + by_mu
            by_damping = by_damping + by_share
        by.table = by_table
        by.damping_factor = by_damping
        return by, tops

    @wp.func
    def sweep_contacts(
        at: Span,
        pace: Pace,
        now: Substep,
        by: By,
        tops: wp.vec4i,
        pairs: Pairs,
        tape: Tape,
        adj: Adjoint,
    ):
        tx = int(tops[0])
        tk = int(tops[2])
        by_contact = by.contact
        tk -= 1
        for _ in range(tape.k[tk]):
            tk -= 1
            tx -= 2
            fetch_ahead(tape.x, tx - now.ahead, wp.static(2 * BYTES))
            by_contact = by_contact + sweep_contact(
                tape.k[tk],
                at.p0,
                tape.x[tx],
                tape.x[tx + 1],
                pace.contact_mu,
                pace.max_recovery,
                pairs,
                now.counts,
                now.on,
                adj,
            )
        by.contact = by_contact
        return by, wp.vec4i(tx, tops[1], tk, tops[3])

    @wp.func
    def sweep_springs(
        at: Span,
        pace: Pace,
        now: Substep,
        by: By,
        tops: wp.vec4i,
        springs: Springs,
        lines: Lines,
        tape: Tape,
        adj: Adjoint,
    ):
        tx = int(tops[0])
        tk = int(tops[2])
        by_inverse_dt2 = by.inverse_dt2
        share = S(1.0)
        passes = int(1)
        if wp.static(with_lines):
            share = S(at.passes)
            passes = at.passes
        inverse_dt2 = pace.inverse_dt2 * share
        own = adj.spring_first[at.g]
        for _ in range(passes):
            tk -= 1
            left = tape.k[tk]
            for r in range(at.s1 - at.s0):
                s = at.s1 - 1 - r
                mode = springs.mode[s]
                direct = bool(False)
                if wp.static(with_lines):
                    direct = mode >= wp.static(int(SpringMode.CHAIN))
                    if direct:
                        # all at once when the first one's turn comes
                        count = springs.run[s]
                        tx -= count
                        if count > 0 and mode == wp.static(int(SpringMode.CHAIN)):
                            by_inverse_dt2 = by_inverse_dt2 + share * sweep_chain(
                                s,
                                own + s,
                                count,
                                at.p0,
                                tx,
                                inverse_dt2,
                                springs,
                                lines,
                                now.counts,
                                now.on,
                                tape,
                                adj,
                            )
                        elif count > 0:
                            by_inverse_dt2 = by_inverse_dt2 + share * sweep_beam(
                                s,
                                own + s,
                                count,
                                at.p0,
                                tx,
                                inverse_dt2,
                                springs,
                                lines,
                                tape,
                                adj,
                            )
                if not direct and mode == wp.static(int(SpringMode.BEND)):
                    tx -= 1
                    by_inverse_dt2 = by_inverse_dt2 + share * sweep_bend(
                        s, own + s, at.p0, tape.x[tx], inverse_dt2, springs, adj
                    )
                elif not direct:
                    acted = mode == wp.static(int(SpringMode.EQUAL))
                    if not acted and left > 0:
                        if tape.k[tk - 1] == s:
                            acted = True
                            tk -= 1
                            left -= 1
                    if acted:
                        tx -= 1
                        fetch_ahead(tape.x, tx - now.ahead, wp.static(BYTES))
                        by_inverse_dt2 = by_inverse_dt2 + share * sweep_distance(
                            s,
                            own + s,
                            at.p0,
                            tape.x[tx],
                            inverse_dt2,
                            springs,
                            now.counts,
                            now.on,
                            adj,
                        )
        by.inverse_dt2 = by_inverse_dt2
        return by, wp.vec4i(tx, tops[1], tk, tops[3])

    @wp.func
    def sweep_grips(
        at: Span,
        pace: Pace,
        tops: wp.vec4i,
        grips: Grips,
        tape: Tape,
        adj: Adjoint,
        ba: BodyAdjoint,
    ):
        counts = at.g * wp.static(KINDS)
        tops[2] -= 1
        for _ in range(tape.k[tops[2]]):
            tops[2] -= wp.static(GRIP_WORDS)
            sweep_grip(
                tops[2], at.world0, at.p0, at.b0, at.bodies, pace.dt, counts, grips, tape, adj, ba
            )
        return tops

    @wp.func
    def sweep_pushes(at: Span, pace: Pace, now: Substep, by: By, grips: Grips, adj: Adjoint):
        by_damping = by.damping_factor
        for p in range(wp.static(L * MOST_PUSHES)):
            lane = p // wp.static(MOST_PUSHES)
            slot = at.world0 * wp.static(MOST_PUSHES) + p
            i = grips.push[slot]
            if i >= 0 and now.number < grips.push_steps[slot] and now.on[lane] > S(0.0):
                gx = adj.x[at.p0 + i]
                kick = grips.push_acceleration[slot] * (pace.dt * pace.dt)
                by_damping[lane] = by_damping[lane] + (
                    gx.x[lane] * kick[0] + gx.y[lane] * kick[1] + gx.z[lane] * kick[2]
                )
        by.damping_factor = by_damping
        return by

    @wp.func
    def sweep_predictions(
        at: Span, pace: Pace, first: int, stride: int, by: By, tape: Tape, adj: Adjoint
    ):
        by_damping = by.damping_factor
        for i in range(at.particles):
            by_damping = by_damping + sweep_predict(
                at.p0 + i, tape.x[first + stride * i], pace.dt, pace.damping_factor, pace.fall, adj
            )
        by.damping_factor = by_damping
        return by

    return SimpleNamespace(
        **vars(t),
        look_ahead=look_ahead,
        open_substep=open_substep,
        sweep_finishes=sweep_finishes,
        sweep_contacts=sweep_contacts,
        sweep_springs=sweep_springs,
        sweep_grips=sweep_grips,
        sweep_pushes=sweep_pushes,
        sweep_predictions=sweep_predictions,
    )
