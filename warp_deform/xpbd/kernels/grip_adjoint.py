"""Adjoint of grips, see `grip`: derivatives by what is held become those by the path's knots."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.rigid_body_adjoint import rigid_body_adjoint
from ..lanes.algebra import add, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["grip_adjoint"]


@functools.cache
def grip_adjoint(scalar: Any, lanes: int, with_bodies: bool) -> SimpleNamespace:
    """`record_grip` notes on the tape where on its path a lane's grip is, `sweep_grip` gives the
    derivatives by what is held to the knots; `held_again` takes back what the end of a launch let
    go.

    Branches: which segment of the path, a descent ended by contact (the rest of the path is shifted
    by knots that lie before), and release (what is let go starts its substep where it is).
    """
    t = structures(scalar, lanes)
    S, R3, Q = t.S, t.R3, t.Q
    Grips, Tape, Adjoint, BodyAdjoint = t.Grips, t.Tape, t.Adjoint, t.BodyAdjoint
    count_one = lane_access(scalar, lanes).count_one
    rotate_adjoint = rigid_body_adjoint(scalar, lanes).rotate_adjoint

    @wp.func
    def record_grip(
        at: int,
        world: int,
        lane: int,
        tick: int,
        knot: int,
        shift: R3,
        released: int,
        grips: Grips,
        tape: Tape,
    ):
        """`tick`, `knot`, `shift`: before the substep. Knots count from the path's end."""
        # a descent that ends in its last substep skips none
        reached = int(0)
        if grips.tick[world] != tick + 1 or wp.length_sq(grips.shift[world] - shift) > S(0.0):
            reached = 1
        held = grips.particle[world]
        if held < 0:
            held = -1 - grips.body[world]
        tape.k[at] = lane
        tape.k[at + 1] = held
        tape.k[at + 2] = grips.tick[world]
        tape.k[at + 3] = grips.knot_end[world] - grips.knot[world]
        tape.k[at + 4] = released
        tape.k[at + 5] = tick
        tape.k[at + 6] = grips.knot_end[world] - knot
        tape.k[at + 7] = reached

    @wp.func
    def along(k: int, clock: S, grips: Grips):
        span = grips.time[k + 1] - grips.time[k]
        return wp.clamp((clock - grips.time[k]) / wp.max(span, S(1.0e-9)), S(0.0), S(1.0))

    @wp.func
    def to_knots(k: int, clock: S, g: R3, turn: Q, grips: Grips, adj: Adjoint):
        """Derivatives g by the tip's position and `turn` by its rotation (4 numbers)."""
        u = along(k, clock, grips)
        rest = S(1.0) - u
        adj.position[k] = adj.position[k] + g * rest
        adj.position[k + 1] = adj.position[k + 1] + g * u
        mixed = grips.rotation[k] * rest + grips.rotation[k + 1] * u
        size = wp.length(mixed)
        unit = mixed * (S(1.0) / size)
        turn = (turn - unit * wp.dot(unit, turn)) * (S(1.0) / size)
        adj.rotation[k] = adj.rotation[k] + turn * rest
        adj.rotation[k + 1] = adj.rotation[k + 1] + turn * u
        span = grips.time[k + 1] - grips.time[k]
        if u > S(0.0) and u < S(1.0) and span > S(1.0e-9):
            gu = wp.dot(g, grips.position[k + 1] - grips.position[k])
            gu += wp.dot(turn, grips.rotation[k + 1] - grips.rotation[k])
            adj.time[k] = adj.time[k] - gu * rest / span
            adj.time[k + 1] = adj.time[k + 1] - gu * u / span

    @wp.func
    def held_again(lane: int, held: int, p0: int, bl: int, adj: Adjoint, ba: BodyAdjoint):
        """bl: row of the lane's first body; `held` as on the tape."""
        if held >= 0:
            i = p0 + held
            mass = adj.w[i]
            mass[lane] = S(0.0)
            adj.w[i] = mass
            v = adj.v[i]
            v.x[lane] = S(0.0)
            v.y[lane] = S(0.0)
            v.z[lane] = S(0.0)
            adj.v[i] = v
        elif wp.static(with_bodies):
            ba.v[bl - 1 - held] = R3()
            ba.omega[bl - 1 - held] = R3()

    @wp.func
    def sweep_grip(
        at: int,
        world0: int,
        p0: int,
        b0: int,
        body_count: int,
        dt: S,
        counts: int,
        grips: Grips,
        tape: Tape,
        adj: Adjoint,
        ba: BodyAdjoint,
    ):
        lane = tape.k[at]
        held = tape.k[at + 1]
        tick = tape.k[at + 2]
        world = world0 + lane
        knot = grips.knot_end[world] - tape.k[at + 3]
        clock = S(tick) * dt
        g = R3()
        still = Q(S(0.0), S(0.0), S(0.0), S(0.0))
        turn = Q(S(0.0), S(0.0), S(0.0), S(0.0))
        kind = counts + wp.static(int(Kind.GRIP))
        if held >= 0:
            i = p0 + held
            gx = adj.x[i]
            go = adj.xp[i]
            if tape.k[at + 4] > 0:
                gx.x[lane] = gx.x[lane] + go.x[lane]
                gx.y[lane] = gx.y[lane] + go.y[lane]
                gx.z[lane] = gx.z[lane] + go.z[lane]
                go.x[lane] = S(0.0)
                go.y[lane] = S(0.0)
                go.z[lane] = S(0.0)
                adj.xp[i] = go
                held_again(lane, held, p0, b0, adj, ba)
            g = R3(gx.x[lane], gx.y[lane], gx.z[lane])
            gx.x[lane] = S(0.0)
            gx.y[lane] = S(0.0)
            gx.z[lane] = S(0.0)
            adj.x[i] = gx
        elif wp.static(with_bodies):
            b = b0 + lane * body_count - 1 - held
            g = ba.x[b]
            gq = ba.q[b]
            if tape.k[at + 4] > 0:
                g += ba.xp[b]
                gq = gq + ba.qp[b]
                ba.xp[b] = R3()
                ba.qp[b] = still
                held_again(lane, held, p0, b0 + lane * body_count, adj, ba)
            ba.x[b] = R3()
            ba.q[b] = still
            u = along(knot, clock, grips)
            mixed = grips.rotation[knot] * (S(1.0) - u) + grips.rotation[knot + 1] * u
            of = grips.turn[world]
            pose = wp.normalize(mixed) * of
            size = wp.length(pose)
            pose = pose * (S(1.0) / size)
            gq = (gq - pose * wp.dot(pose, gq)) * (S(1.0) / size)
            turn = gq * Q(-of[0], -of[1], -of[2], of[3])
        if wp.length_sq(grips.offset[world]) > S(0.0):
            u = along(knot, clock, grips)
            mixed = grips.rotation[knot] * (S(1.0) - u) + grips.rotation[knot + 1] * u
            turn = turn + rotate_adjoint(grips.offset[world], wp.normalize(mixed), g)
        to_knots(knot, clock, g, turn, grips, adj)
        shift = adj.shift[world] + g
        before = tape.k[at + 5]
        if tape.k[at + 7] > 0:
            kind = counts + wp.static(int(Kind.REACHED))
            to_knots(knot, clock, -shift, still, grips, adj)
            reached_clock = S(before + 1) * dt - dt
            k = int(grips.knot_end[world] - tape.k[at + 6])
            while k + 2 < grips.knot_end[world] and grips.time[k + 1] <= reached_clock:
                k += 1
            to_knots(k, reached_clock, shift, still, grips, adj)
            shift = R3()
        adj.shift[world] = shift
        if tape.k[at + 4] > 0:
            kind = counts + wp.static(int(Kind.RELEASE))
        count_one(kind, lane, adj)

    return SimpleNamespace(record_grip=record_grip, sweep_grip=sweep_grip, held_again=held_again)
