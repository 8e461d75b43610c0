"""Particles on the table (the plane z = 0), and the velocity update that ends a substep."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .friction import friction
from .lanes import add, any_less, div, dot, mul, root, select, sub  # noqa: F401  (operators)
from .structures import structures

__all__ = ["table_contact"]


@functools.cache
def table_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`predict` begins a substep for a particle, `finish` ends it.

    `finish` pushes the particle out of the table, applies Coulomb friction to its horizontal step,
    and derives the velocity. It returns the squared length of the whole step [m^2] before clamping.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles = t.S, t.V, t.V3, t.Particles
    coulomb = friction(scalar, lanes).coulomb

    @wp.func
    def predict(i: int, dt: S, kept: V, fall: V3, q: Particles):
        x = q.x[i]
        q.xp[i] = x
        free = select(q.w[i], V(dt), V(S(0.0)))
        q.x[i] = x + (q.v[i] + fall) * (kept * free)

    @wp.func
    def finish(
        i: int, radius: S, inverse_dt: S, mu: V, fastest: V, all_on: bool, on: V, q: Particles
    ):
        x = q.x[i]
        o = q.xp[i]
        zero = V(S(0.0))
        if any_less(x.z, radius):
            depth = select(q.w[i], wp.max(V(radius) - x.z, zero), zero)
            dx = x.x - o.x
            dy = x.y - o.y
            f = coulomb(dx * dx + dy * dy, depth * mu)
            x = V3(x.x - dx * f, x.y - dy * f, x.z + depth)
        d = x - o
        moved2 = dot(d, d)
        v = d * inverse_dt
        # divide only where the clamp may act; fastest [m] is the longest step allowed
        if any_less(fastest * fastest - moved2, S(0.0)):
            v = v * wp.min(V(S(1.0)), fastest / wp.max(root(moved2), V(S(1.0e-12))))
        if not all_on:
            u = q.v[i]
            x = V3(select(on, x.x, o.x), select(on, x.y, o.y), select(on, x.z, o.z))
            v = V3(select(on, v.x, u.x), select(on, v.y, u.y), select(on, v.z, u.z))
            moved2 = moved2 * on
        q.x[i] = x
        q.v[i] = v
        return moved2

    return SimpleNamespace(predict=predict, finish=finish)
