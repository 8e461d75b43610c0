"""Grips: a particle or a body follows the tip along a path of knots, and is let go at its end."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.box_particle import box_particle
from ..bodies.box_table import box_table
from ..contact.sphere_contact import sphere_contact
from ..lanes.algebra import add, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.group_state import group_state
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["grip", "grip_adjoint"]

CONTACT = 1.0e-4
"""A held box this close to the table [m] counts as having reached it."""


@functools.cache
def grip(scalar: Any, lanes: int) -> SimpleNamespace:
    """`follow_path` moves what one lane holds by one substep and returns whether it still holds it;
    `met` says that what it holds has met a triangle.

    Positions are linear between knots, rotations normalised linear. Between `lower_start` and
    `lower_end` the descent ends where the held thing meets anything; the rest of the path (the
    dwell) is then shifted to that place. Held things are kinematic: their inverse mass is 0.
    """
    t = group_state(scalar, lanes)
    S, R3, Span, Topology = t.S, t.R3, t.Span, t.Topology
    Shapes, Pairs, Particles = t.Shapes, t.Pairs, t.Particles
    Bodies, Grips, Near = t.Bodies, t.Grips, t.Near
    touches = sphere_contact(scalar, lanes).touches
    corner = box_table(scalar, lanes).corner
    particle_gap = box_particle(scalar, lanes).particle_gap

    @wp.func
    def tip_position(w: int, clock: S, grips: Grips):
        k = grips.knot[w]
        span = grips.time[k + 1] - grips.time[k]
        u = wp.clamp((clock - grips.time[k]) / wp.max(span, S(1.0e-9)), S(0.0), S(1.0))
        return grips.position[k] * (S(1.0) - u) + grips.position[k + 1] * u + grips.shift[w]

    @wp.func
    def tip_rotation(w: int, clock: S, grips: Grips):
        k = grips.knot[w]
        span = grips.time[k + 1] - grips.time[k]
        u = wp.clamp((clock - grips.time[k]) / wp.max(span, S(1.0e-9)), S(0.0), S(1.0))
        return wp.normalize(grips.rotation[k] * (S(1.0) - u) + grips.rotation[k + 1] * u)

    @wp.func
    def set_knot(w: int, clock: S, grips: Grips):
        k = grips.knot[w]
        while k + 2 < grips.knot_end[w] and grips.time[k + 1] <= clock:
            k += 1
        grips.knot[w] = k

    @wp.func
    def reached(
        w: int, lane: int, at: Span, near_count: int, top: Topology, q: Particles, pairs: Pairs,
        shapes: Shapes, near: Near, bodies: Bodies, grips: Grips,
    ):  # fmt: skip
        """Whether a held particle touches another one or a box, or a held body anything."""
        hit = bool(False)
        b0 = at.b0 + lane * at.bodies
        first = at.shape0 + lane * at.shapes
        last = first + at.shapes
        particle = grips.particle[w]
        if particle >= 0:
            radius = top.radius[at.radii + particle]
            hit = touches(particle, lane, at.p0, at.near0, near_count, q, pairs, near)
            x = q.x[at.p0 + particle]
            p = R3(x.x[lane], x.y[lane], x.z[lane])
            for shape in range(first, last):
                gap = particle_gap(p, shape, b0 + shapes.body[shape], shapes, bodies)
                if gap < radius + S(CONTACT):
                    hit = True
        else:
            b = b0 + grips.body[w]
            hit = bodies.touching[b] > 0
            for shape in range(first, last):
                if shapes.body[shape] == grips.body[w]:
                    for c in range(8):
                        z = (
                            bodies.x[b][2]
                            + wp.quat_rotate(bodies.q[b], corner(shape, c, shapes))[2]
                        )
                        if z < S(CONTACT):
                            hit = True
        return hit

    @wp.func
    def follow_path(
        lane: int, met: bool, at: Span, near_count: int, dt: S, top: Topology, q: Particles,
        pairs: Pairs, shapes: Shapes, near: Near, bodies: Bodies, grips: Grips,
    ):  # fmt: skip
        w = at.w0 + lane
        tick = grips.tick[w] + 1
        clock = S(tick) * dt
        if clock > grips.lower_start[w] and clock < grips.lower_end[w]:
            if met or reached(w, lane, at, near_count, top, q, pairs, shapes, near, bodies, grips):
                set_knot(w, clock - dt, grips)
                here = tip_position(w, clock - dt, grips)
                tick = int(grips.lower_end[w] / dt)
                clock = S(tick) * dt
                set_knot(w, clock, grips)
                grips.shift[w] = here - tip_position(w, clock, grips)
        grips.tick[w] = tick
        set_knot(w, clock, grips)
        position = tip_position(w, clock, grips)
        rotation = tip_rotation(w, clock, grips)
        held = position + wp.quat_rotate(rotation, grips.offset[w])
        particle = grips.particle[w]
        if particle >= 0:
            i = at.p0 + particle
            x = q.x[i]
            x.x[lane] = held[0]
            x.y[lane] = held[1]
            x.z[lane] = held[2]
            q.x[i] = x
        else:
            b = at.b0 + lane * at.bodies + grips.body[w]
            bodies.x[b] = held
            bodies.q[b] = wp.normalize(rotation * grips.turn[w])
        return clock < grips.time[grips.knot_end[w] - 1]

    @wp.func
    def take(w: int, lane: int, p0: int, b0: int, q: Particles, bodies: Bodies, grips: Grips):
        """What is gripped becomes kinematic."""
        if grips.particle[w] >= 0:
            mass = q.w[p0 + grips.particle[w]]
            mass[lane] = S(0.0)
            q.w[p0 + grips.particle[w]] = mass
        elif grips.body[w] >= 0:
            bodies.w[b0 + grips.body[w]] = S(0.0)

    @wp.func
    def let_go(w: int, lane: int, p0: int, b0: int, q: Particles, bodies: Bodies, grips: Grips):
        """What was gripped is free again, and at rest: its step of this substep does not count."""
        particle = grips.particle[w]
        if particle >= 0:
            i = p0 + particle
            mass = q.w[i]
            free = q.w0[i]
            mass[lane] = free[lane]
            q.w[i] = mass
            v = q.v[i]
            v.x[lane] = S(0.0)
            v.y[lane] = S(0.0)
            v.z[lane] = S(0.0)
            q.v[i] = v
            x = q.x[i]
            start = q.xp[i]
            start.x[lane] = x.x[lane]
            start.y[lane] = x.y[lane]
            start.z[lane] = x.z[lane]
            q.xp[i] = start
        else:
            b = b0 + grips.body[w]
            bodies.w[b] = bodies.w0[b]
            bodies.xp[b] = bodies.x[b]
            bodies.qp[b] = bodies.q[b]
            bodies.v[b] = R3()
            bodies.omega[b] = R3()
        grips.particle[w] = -1
        grips.body[w] = -1

    return SimpleNamespace(follow_path=follow_path, take=take, let_go=let_go)


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

    @wp.func
    def record_grip(
        at: int, w: int, lane: int, tick: int, knot: int, shift: R3, released: int, grips: Grips,
        tape: Tape,
    ):  # fmt: skip
        """`tick`, `knot`, `shift`: before the substep. Knots count from the path's end."""
        # a descent that ends in its last substep skips none
        reached = int(0)
        if grips.tick[w] != tick + 1 or wp.length_sq(grips.shift[w] - shift) > S(0.0):
            reached = 1
        held = grips.particle[w]
        if held < 0:
            held = -1 - grips.body[w]
        tape.k[at] = lane
        tape.k[at + 1] = held
        tape.k[at + 2] = grips.tick[w]
        tape.k[at + 3] = grips.knot_end[w] - grips.knot[w]
        tape.k[at + 4] = released
        tape.k[at + 5] = tick
        tape.k[at + 6] = grips.knot_end[w] - knot
        tape.k[at + 7] = reached

    @wp.func
    def turned_by(o: R3, q: Q, g: R3):
        """Derivative by q of `g . quat_rotate(q, o)`."""
        v = R3(q[0], q[1], q[2])
        r = (
            wp.cross(o, g) * (S(2.0) * q[3])
            + g * (S(2.0) * wp.dot(v, o))
            + o * (S(2.0) * wp.dot(v, g))
        )
        s = S(4.0) * q[3] * wp.dot(g, o) + S(2.0) * wp.dot(g, wp.cross(v, o))
        return Q(r[0], r[1], r[2], s)

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
        at: int, w0: int, p0: int, b0: int, body_count: int, dt: S, counts: int, grips: Grips,
        tape: Tape, adj: Adjoint, ba: BodyAdjoint,
    ):  # fmt: skip
        lane = tape.k[at]
        held = tape.k[at + 1]
        tick = tape.k[at + 2]
        w = w0 + lane
        knot = grips.knot_end[w] - tape.k[at + 3]
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
            of = grips.turn[w]
            pose = wp.normalize(mixed) * of
            size = wp.length(pose)
            pose = pose * (S(1.0) / size)
            gq = (gq - pose * wp.dot(pose, gq)) * (S(1.0) / size)
            turn = gq * Q(-of[0], -of[1], -of[2], of[3])
        if wp.length_sq(grips.offset[w]) > S(0.0):
            u = along(knot, clock, grips)
            mixed = grips.rotation[knot] * (S(1.0) - u) + grips.rotation[knot + 1] * u
            turn = turn + turned_by(grips.offset[w], wp.normalize(mixed), g)
        to_knots(knot, clock, g, turn, grips, adj)
        shift = adj.shift[w] + g
        before = tape.k[at + 5]
        if tape.k[at + 7] > 0:
            kind = counts + wp.static(int(Kind.REACHED))
            to_knots(knot, clock, -shift, still, grips, adj)
            here = S(before + 1) * dt - dt
            k = int(grips.knot_end[w] - tape.k[at + 6])
            while k + 2 < grips.knot_end[w] and grips.time[k + 1] <= here:
                k += 1
            to_knots(k, here, shift, still, grips, adj)
            shift = R3()
        adj.shift[w] = shift
        if tape.k[at + 4] > 0:
            kind = counts + wp.static(int(Kind.RELEASE))
        count_one(kind, lane, adj)

    return SimpleNamespace(
        record_grip=record_grip, sweep_grip=sweep_grip, held_again=held_again, turned_by=turned_by
    )
