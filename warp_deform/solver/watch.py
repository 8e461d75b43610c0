"""What the guards look at inside the kernel: the worst values of a launch, world by world."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, length, mul, nonfinite, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["watch"]


@functools.cache
def watch(scalar: Any, lanes: int, with_bodies: bool) -> SimpleNamespace:
    """`watch_group(g, ...)`: a look at all worlds of a group."""
    t = structures(scalar, lanes)
    S, V, L = t.S, t.V, t.L
    Springs, Particles, Bodies, Watch = t.Springs, t.Particles, t.Bodies, t.Watch

    @wp.func
    def watch_group(
        g: int, p0: int, n: int, s0: int, s1: int, b0: int, body_count: int, springs: Springs,
        q: Particles, bodies: Bodies, watch: Watch,
    ):  # fmt: skip
        """Worst values of the guards, once every `check_every` substeps."""
        zero = V(S(0.0))
        bad = watch.nonfinite[g]
        lowest = V(S(1.0e9))
        for i in range(p0, p0 + n):
            x = q.x[i]
            bad = wp.max(bad, nonfinite(x.x + x.y + x.z))
            lowest = wp.min(lowest, x.z)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                for b in range(b0 + lane * body_count, b0 + (lane + 1) * body_count):
                    sum = bodies.x[b] + bodies.omega[b]
                    if not wp.isfinite(sum[0] + sum[1] + sum[2]):
                        bad[lane] = S(1.0)
        watch.nonfinite[g] = bad
        watch.depth[g] = wp.max(watch.depth[g], wp.max(zero - lowest, zero))
        stretch = watch.stretch[g]
        for s in range(s0, s1):
            if springs.watched[s] > 0:
                ij = springs.ij[s]
                l = length(q.x[p0 + ij[0]] - q.x[p0 + ij[1]])
                stretch = wp.max(stretch, l * (S(1.0) / springs.length[s]))
        watch.stretch[g] = stretch

    return SimpleNamespace(watch_group=watch_group)
