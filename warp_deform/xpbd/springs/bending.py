"""Bending springs: a particle is pulled towards the middle of its two neighbours.

The energy is k / 2 (|d| - h)^2 with the offset d = x_j - (x_i + x_k) / 2, which for slight bends is
the curvature times D^2 / 2 in a chain of spacing D. With h = 0 the chain is a beam of bending
stiffness E I = k D^3 / 4; h > 0 keeps a ring round. Solved as in XPBD (see `distance`).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, div, dot, less, mul, root, select, sub  # noqa: F401  (operators)
from ..lanes.structures import structures

__all__ = ["bending", "bending_adjoint"]


@functools.cache
def bending(scalar: Any, lanes: int, taped: bool = False) -> SimpleNamespace:
    """`project_bend(k, p0, at, inverse_dt2, particles, springs, tape)`: solve bending spring `k`.

    `taped`, it leaves its offset d on the tape.

    With the constraint |d| - h and its gradients 1 on the middle particle and -1/2 on the ends,
    ``lambda = (|d| - h) / (wj + (wi + wk) / 4 + a / dt^2)``.
    """
    t = structures(scalar, lanes)
    S, V, Particles, Springs, Tape = t.S, t.V, t.Particles, t.Springs, t.Tape

    @wp.func
    def project_bend(
        k: int, p0: int, at: int, inverse_dt2: V, particles: Particles, springs: Springs, tape: Tape
    ):
        ends = springs.ij[k]
        i = p0 + ends[0]
        j = p0 + springs.middle[k]
        e = p0 + ends[1]
        wi = particles.w[i]
        wj = particles.w[j]
        we = particles.w[e]
        half = S(0.5)
        xi = particles.x[i]
        xj = particles.x[j]
        xe = particles.x[e]
        d = xj - (xi + xe) * half
        if wp.static(taped):
            tape.x[at] = d
        tiny = V(S(1.0e-9))
        l = wp.max(root(dot(d, d)), tiny)
        w = wj + (wi + we) * S(0.25) + inverse_dt2 * springs.compliance[k] + tiny
        s = (l - V(springs.length[k])) / (l * w)
        particles.x[i] = xi + d * (s * wi * half)
        particles.x[e] = xe + d * (s * we * half)
        particles.x[j] = xj - d * (s * wj)

    return SimpleNamespace(project_bend=project_bend)


@functools.cache
def bending_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_bend` takes a bending spring of offset d back: the derivatives by the three particles,
    inverse masses, the spring's own (at `own`) and `inverse_dt2` (returned).
    """
    t = structures(scalar, lanes)
    S, V, V3, Springs, Adjoint = t.S, t.V, t.V3, t.Springs, t.Adjoint

    @wp.func
    def sweep_bend(
        k: int, own: int, p0: int, d: V3, inverse_dt2: V, springs: Springs, adj: Adjoint
    ):
        ends = springs.ij[k]
        i = p0 + ends[0]
        j = p0 + springs.middle[k]
        e = p0 + ends[1]
        wi = adj.w[i]
        wj = adj.w[j]
        we = adj.w[e]
        zero = V(S(0.0))
        half = S(0.5)
        tiny = V(S(1.0e-9))
        exact = root(dot(d, d))
        l = wp.max(exact, tiny)
        w = wj + (wi + we) * S(0.25) + inverse_dt2 * springs.compliance[k] + tiny
        rest = V(springs.length[k])
        s = (l - rest) / (l * w)
        gi = adj.x[i]
        gj = adj.x[j]
        ge = adj.x[e]
        b = gi * (wi * half) + ge * (we * half) - gj * wj
        di = dot(d, gi) * half
        dj = dot(d, gj)
        de = dot(d, ge) * half
        gs = di * wi + de * we - dj * wj
        gd = b * s + d * (gs * rest * less(tiny, exact) / (l * l * l * w))
        adj.x[i] = gi - gd * half
        adj.x[e] = ge - gd * half
        adj.x[j] = gj + gd
        gw = zero - gs * s / w
        if adj.parts > 0:
            quarter = gw * S(0.25)
            adj.mass[i] = adj.mass[i] + select(wi, quarter + s * di, zero)
            adj.mass[e] = adj.mass[e] + select(we, quarter + s * de, zero)
            adj.mass[j] = adj.mass[j] + select(wj, gw - s * dj, zero)
            adj.softness[own] = adj.softness[own] + gw
            adj.rest[own] = adj.rest[own] - gs / (l * w)
        return gw * springs.compliance[k]

    return SimpleNamespace(sweep_bend=sweep_bend)
