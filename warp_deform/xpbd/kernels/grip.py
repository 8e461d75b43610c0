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

__all__ = ["grip"]

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
    def tip_position(world: int, clock: S, grips: Grips):
        k = grips.knot[world]
        span = grips.time[k + 1] - grips.time[k]
        u = wp.clamp((clock - grips.time[k]) / wp.max(span, S(1.0e-9)), S(0.0), S(1.0))
        return grips.position[k] * (S(1.0) - u) + grips.position[k + 1] * u + grips.shift[world]

    @wp.func
    def tip_rotation(world: int, clock: S, grips: Grips):
        k = grips.knot[world]
        span = grips.time[k + 1] - grips.time[k]
        u = wp.clamp((clock - grips.time[k]) / wp.max(span, S(1.0e-9)), S(0.0), S(1.0))
        return wp.normalize(grips.rotation[k] * (S(1.0) - u) + grips.rotation[k + 1] * u)

    @wp.func
    def set_knot(world: int, clock: S, grips: Grips):
        k = grips.knot[world]
        while k + 2 < grips.knot_end[world] and grips.time[k + 1] <= clock:
            k += 1
        grips.knot[world] = k

    @wp.func
    def reached(
        world: int,
        lane: int,
        at: Span,
        near_count: int,
        top: Topology,
        particles: Particles,
        pairs: Pairs,
        shapes: Shapes,
        near: Near,
        bodies: Bodies,
        grips: Grips,
    ):
        """Whether a held particle touches another one or a box, or a held body anything."""
        hit = bool(False)
        b0 = at.b0 + lane * at.bodies
        first = at.shape0 + lane * at.shapes
        last = first + at.shapes
        particle = grips.particle[world]
        if particle >= 0:
            radius = top.radius[at.radii + particle]
            hit = touches(particle, lane, at.p0, at.near0, near_count, particles, pairs, near)
            x = particles.x[at.p0 + particle]
            p = R3(x.x[lane], x.y[lane], x.z[lane])
            for shape in range(first, last):
                gap = particle_gap(p, shape, b0 + shapes.body[shape], shapes, bodies)
                if gap < radius + S(CONTACT):
                    hit = True
        else:
            b = b0 + grips.body[world]
            hit = bodies.touching[b] > 0
            for shape in range(first, last):
                if shapes.body[shape] == grips.body[world]:
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
        lane: int,
        met: bool,
        at: Span,
        near_count: int,
        dt: S,
        top: Topology,
        particles: Particles,
        pairs: Pairs,
        shapes: Shapes,
        near: Near,
        bodies: Bodies,
        grips: Grips,
    ):
        world = at.world0 + lane
        tick = grips.tick[world] + 1
        clock = S(tick) * dt
        if clock > grips.lower_start[world] and clock < grips.lower_end[world]:
            if met or reached(
                world, lane, at, near_count, top, particles, pairs, shapes, near, bodies, grips
            ):
                set_knot(world, clock - dt, grips)
                reached_position = tip_position(world, clock - dt, grips)
                tick = int(grips.lower_end[world] / dt)
                clock = S(tick) * dt
                set_knot(world, clock, grips)
                grips.shift[world] = reached_position - tip_position(world, clock, grips)
        grips.tick[world] = tick
        set_knot(world, clock, grips)
        position = tip_position(world, clock, grips)
        rotation = tip_rotation(world, clock, grips)
        held = position + wp.quat_rotate(rotation, grips.offset[world])
        particle = grips.particle[world]
        if particle >= 0:
            i = at.p0 + particle
            x = particles.x[i]
            x.x[lane] = held[0]
            x.y[lane] = held[1]
            x.z[lane] = held[2]
            particles.x[i] = x
        else:
            b = at.b0 + lane * at.bodies + grips.body[world]
            bodies.x[b] = held
            bodies.q[b] = wp.normalize(rotation * grips.turn[world])
        return clock < grips.time[grips.knot_end[world] - 1]

    @wp.func
    def take(
        world: int, lane: int, p0: int, b0: int, particles: Particles, bodies: Bodies, grips: Grips
    ):
        """What is gripped becomes kinematic."""
        if grips.particle[world] >= 0:
            mass = particles.w[p0 + grips.particle[world]]
            mass[lane] = S(0.0)
            particles.w[p0 + grips.particle[world]] = mass
        elif grips.body[world] >= 0:
            bodies.w[b0 + grips.body[world]] = S(0.0)

    @wp.func
    def let_go(
        world: int, lane: int, p0: int, b0: int, particles: Particles, bodies: Bodies, grips: Grips
    ):
        """What was gripped is free again, and at rest: its step of this substep does not count."""
        particle = grips.particle[world]
        if particle >= 0:
            i = p0 + particle
            mass = particles.w[i]
            free = particles.w0[i]
            mass[lane] = free[lane]
            particles.w[i] = mass
            v = particles.v[i]
            v.x[lane] = S(0.0)
            v.y[lane] = S(0.0)
            v.z[lane] = S(0.0)
            particles.v[i] = v
            x = particles.x[i]
            start = particles.xp[i]
            start.x[lane] = x.x[lane]
            start.y[lane] = x.y[lane]
            start.z[lane] = x.z[lane]
            particles.xp[i] = start
        else:
            b = b0 + grips.body[world]
            bodies.w[b] = bodies.w0[b]
            bodies.xp[b] = bodies.x[b]
            bodies.qp[b] = bodies.q[b]
            bodies.v[b] = R3()
            bodies.omega[b] = R3()
        grips.particle[world] = -1
        grips.body[world] = -1

    return SimpleNamespace(follow_path=follow_path, take=take, let_go=let_go)
