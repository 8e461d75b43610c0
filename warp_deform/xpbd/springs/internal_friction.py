"""What brings fabrics to rest: viscosity along their edges, dry friction, and sleep.

Viscosity conserves momentum. Dry friction is a constant deceleration, as of threads that rub on
each other; it holds folds. Sleep ends the last jitter of a crumpled sheet: a particle slower than
the sleep speed stays where it is, and the sleep speed rises from 1 s to 2 s after a release.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["internal_friction", "internal_friction_adjoint"]


@functools.cache
def internal_friction(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sleep_speed(free, ...)`: the sleep speed `free` seconds after a release, by lane.

    `calm_particle(i, dry, sleep, on, particles)`: dry friction and sleep of one particle after its
    velocity is known; returns its squared speed. `damp_spring(s, p0, share, on, particles,
    springs)`: viscosity of one spring.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles, Springs = t.S, t.V, t.V3, t.Particles, t.Springs

    @wp.func
    def sleep_speed(free: V, speed: S, ramp: S):
        late = wp.min(wp.max(free - V(S(1.0)), V(S(0.0))), V(S(1.0)))
        return (V(S(1.0)) + late * (ramp - S(1.0))) * speed

    @wp.func
    def calm_particle(i: int, dry: S, sleep: V, on: V, particles: Particles):
        v = particles.v[i]
        speed2 = dot(v, v)
        zero = V(S(0.0))
        one = V(S(1.0))
        speed = root(speed2)
        friction_factor = wp.max(speed - V(dry), zero) / wp.max(speed, V(S(1.0e-12)))
        # what is held or frozen keeps its velocity
        free = on * less(zero, particles.w[i])
        friction_factor = select(free, friction_factor, one)
        asleep = less(speed * friction_factor, sleep) * free
        v = v * (friction_factor * (one - asleep))
        if any_less(zero - asleep, S(0.0)):
            x = particles.x[i]
            o = particles.xp[i]
            particles.x[i] = V3(
                select(asleep, o.x, x.x), select(asleep, o.y, x.y), select(asleep, o.z, x.z)
            )
        particles.v[i] = v
        return dot(v, v) * on

    @wp.func
    def damp_spring(s: int, p0: int, share: S, on: V, particles: Particles, springs: Springs):
        ij = springs.ij[s]
        i = p0 + ij[0]
        j = p0 + ij[1]
        wi = particles.w[i]
        wj = particles.w[j]
        vi = particles.v[i]
        vj = particles.v[j]
        lost = (vi - vj) * (on * share / (wi + wj + V(S(1.0e-9))))
        particles.v[i] = vi - lost * wi
        particles.v[j] = vj + lost * wj

    return SimpleNamespace(
        sleep_speed=sleep_speed, calm_particle=calm_particle, damp_spring=damp_spring
    )


@functools.cache
def internal_friction_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_spring` leaves the relative velocity of a damped spring on the tape, `sweep_spring`
    takes it back. `sweep_calm` needs no tape: its velocity v follows from the positions.

    Branches: asleep (the step is undone and the velocity lost), and stopped by dry friction.
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Particles, Springs, Tape, Adjoint = t.Particles, t.Springs, t.Tape, t.Adjoint
    damp_spring = internal_friction(scalar, lanes).damp_spring

    @wp.func
    def record_spring(
        s: int,
        p0: int,
        at: int,
        share: S,
        on: V,
        particles: Particles,
        springs: Springs,
        tape: Tape,
    ):
        ij = springs.ij[s]
        tape.x[at] = particles.v[p0 + ij[0]] - particles.v[p0 + ij[1]]
        damp_spring(s, p0, share, on, particles, springs)

    @wp.func
    def sweep_spring(s: int, p0: int, d: V3, share: S, on: V, springs: Springs, adj: Adjoint):
        ij = springs.ij[s]
        i = p0 + ij[0]
        j = p0 + ij[1]
        zero = V(S(0.0))
        wi = adj.w[i]
        wj = adj.w[j]
        inverse = V(S(1.0)) / (wi + wj + V(S(1.0e-9)))
        factor = on * share * inverse
        gi = adj.v[i]
        gj = adj.v[j]
        g = (gj * wj - gi * wi) * factor
        adj.v[i] = gi + g
        adj.v[j] = gj - g
        gw = zero - dot(g, d) * inverse
        adj.mass[i] = adj.mass[i] + select(wi, gw - factor * dot(d, gi), zero)
        adj.mass[j] = adj.mass[j] + select(wj, gw + factor * dot(d, gj), zero)

    @wp.func
    def sweep_calm(i: int, v: V3, g: V3, dry: S, sleep: V, on: V, counts: int, adj: Adjoint):
        """Derivative by the velocity v before; `g` by that after it, 0 where the lane is off."""
        zero = V(S(0.0))
        one = V(S(1.0))
        speed = root(dot(v, v))
        safe = wp.max(speed, V(S(1.0e-12)))
        friction_factor = wp.max(speed - V(dry), zero) / safe
        free = on * less(zero, adj.w[i])
        friction_factor = select(free, friction_factor, one)
        asleep = less(speed * friction_factor, sleep) * free
        rubs = less(V(dry), speed) * free
        kind = counts + wp.static(int(Kind.SLEEP))
        adj.fired[kind] = adj.fired[kind] + asleep
        kind = counts + wp.static(int(Kind.DRY_FRICTION))
        adj.fired[kind] = adj.fired[kind] + rubs * wp.sign(dry)
        if any_less(zero - asleep, S(0.0)):
            back = adj.x[i] * asleep
            adj.x[i] = adj.x[i] - back
            adj.xp[i] = adj.xp[i] + back
        g = g * (one - asleep)
        return g * friction_factor + v * (dot(v, g) * rubs * dry / (safe * safe * safe))

    return SimpleNamespace(
        record_spring=record_spring, sweep_spring=sweep_spring, sweep_calm=sweep_calm
    )
