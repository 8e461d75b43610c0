"""What brings fabrics to rest: viscosity along their edges, dry friction, and sleep.

Viscosity conserves momentum. Dry friction is a constant deceleration, as of threads that rub on
each other; it holds folds. Sleep ends the last jitter of a crumpled sheet: a particle slower than
the sleep speed stays where it is, and the sleep speed rises from 1 s to 2 s after a release.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from .structures import structures

__all__ = ["internal_friction"]


@functools.cache
def internal_friction(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sleep_speed(free, ...)`: the sleep speed `free` seconds after a release, by lane.

    `calm_particle(i, dry, sleep, on, q)`: dry friction and sleep of one particle after its velocity
    is known; returns its squared speed. `damp_spring(s, p0, share, on, q, springs)`: viscosity of
    one spring.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles, Springs = t.S, t.V, t.V3, t.Particles, t.Springs

    @wp.func
    def sleep_speed(free: V, speed: S, ramp: S):
        late = wp.min(wp.max(free - V(S(1.0)), V(S(0.0))), V(S(1.0)))
        return (V(S(1.0)) + late * (ramp - S(1.0))) * speed

    @wp.func
    def calm_particle(i: int, dry: S, sleep: V, on: V, q: Particles):
        v = q.v[i]
        speed2 = dot(v, v)
        zero = V(S(0.0))
        one = V(S(1.0))
        speed = root(speed2)
        kept = wp.max(speed - V(dry), zero) / wp.max(speed, V(S(1.0e-12)))
        # what is held or frozen keeps its velocity
        free = on * less(zero, q.w[i])
        kept = select(free, kept, one)
        asleep = less(speed * kept, sleep) * free
        v = v * (kept * (one - asleep))
        if any_less(zero - asleep, S(0.0)):
            x = q.x[i]
            o = q.xp[i]
            q.x[i] = V3(
                select(asleep, o.x, x.x), select(asleep, o.y, x.y), select(asleep, o.z, x.z)
            )
        q.v[i] = v
        return dot(v, v) * on

    @wp.func
    def damp_spring(s: int, p0: int, share: S, on: V, q: Particles, springs: Springs):
        ij = springs.ij[s]
        i = p0 + ij[0]
        j = p0 + ij[1]
        wi = q.w[i]
        wj = q.w[j]
        vi = q.v[i]
        vj = q.v[j]
        lost = (vi - vj) * (on * share / (wi + wj + V(S(1.0e-9))))
        q.v[i] = vi - lost * wi
        q.v[j] = vj + lost * wj

    return SimpleNamespace(
        sleep_speed=sleep_speed, calm_particle=calm_particle, damp_spring=damp_spring
    )
