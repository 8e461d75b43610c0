"""Bending springs: a particle is pulled towards the middle of its two neighbours.

The energy is k / 2 (|d| - h)^2 with the offset d = x_j - (x_i + x_k) / 2, which for slight bends is
the curvature times D^2 / 2 in a chain of spacing D. With h = 0 the chain is a beam of bending
stiffness E I = k D^3 / 4; h > 0 keeps a ring round. Solved as in XPBD (see `distance`).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, div, dot, mul, root, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["bending"]


@functools.cache
def bending(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_bend(k, p0, inverse_dt2, q, springs)`: solve bending spring `k`.

    With the constraint |d| - h and its gradients 1 on the middle particle and -1/2 on the ends,
    ``lambda = (|d| - h) / (wj + (wi + wk) / 4 + a / dt^2)``.
    """
    t = structures(scalar, lanes)
    S, V, Particles, Springs = t.S, t.V, t.Particles, t.Springs

    @wp.func
    def project_bend(k: int, p0: int, inverse_dt2: V, q: Particles, springs: Springs):
        ends = springs.ij[k]
        i = p0 + ends[0]
        j = p0 + springs.middle[k]
        e = p0 + ends[1]
        wi = q.w[i]
        wj = q.w[j]
        we = q.w[e]
        half = S(0.5)
        d = q.x[j] - (q.x[i] + q.x[e]) * half
        tiny = V(S(1.0e-9))
        l = wp.max(root(dot(d, d)), tiny)
        w = wj + (wi + we) * S(0.25) + inverse_dt2 * springs.compliance[k] + tiny
        s = (l - V(springs.length[k])) / (l * w)
        q.x[i] = q.x[i] + d * (s * wi * half)
        q.x[e] = q.x[e] + d * (s * we * half)
        q.x[j] = q.x[j] - d * (s * wj)

    return SimpleNamespace(project_bend=project_bend)
