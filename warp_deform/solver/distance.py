"""Distance constraints: links, fold limits, tension-only diagonals, bending across a joint.

Source: Macklin, Mueller, Chentanez, "XPBD", 2016, equation 18 with one iteration a substep. A
spring of stiffness k has compliance 1 / k, so it converges to Hooke's law as the substep shrinks.
Bending is a soft spring between second neighbours (or across a shared edge).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, any_less, div, dot, mul, root, sub  # noqa: F401  (operators by name)
from .structures import structures

__all__ = ["distance"]


@functools.cache
def distance(scalar: Any, lanes: int, with_floors: bool = False) -> SimpleNamespace:
    """`project_distance(k, p0, inverse_dt2, q, springs)`: solve spring `k`.

    For a two-sided spring (mode 0) of length l, rest length L and compliance a,
    ``lambda = (l - L) / (wi + wj + a / dt^2)`` moves both ends along the spring. AT_LEAST (mode 1)
    acts only when l < L, AT_MOST (mode 2) only when l > L. With a strain limit X the correction is
    at least the rigid one for l > X, in the same solve; with a floor (and `with_floors`), it is so
    for l < floor as well, whatever the mode.
    """
    t = structures(scalar, lanes)
    S, V, Particles, Springs = t.S, t.V, t.Particles, t.Springs

    @wp.func
    def project_distance(k: int, p0: int, inverse_dt2: V, q: Particles, springs: Springs):
        ij = springs.ij[k]
        i = p0 + ij[0]
        j = p0 + ij[1]
        rest = springs.length[k]
        mode = springs.mode[k]
        xi = q.x[i]
        xj = q.x[j]
        d = xi - xj
        l2 = dot(d, d)
        acts = mode == 0 or (mode == 1 and any_less(l2, rest * rest))
        if mode == 2:
            acts = any_less(V(rest * rest) - l2, S(0.0))
            if wp.static(with_floors):
                acts = acts or any_less(l2, springs.floor[k] * springs.floor[k])
        if acts:
            zero = V(S(0.0))
            tiny = V(S(1.0e-9))
            l = root(l2)
            c = l - V(rest)
            if mode == 1:
                c = wp.min(c, zero)
            if mode == 2:
                c = wp.max(c, zero)
            wi = q.w[i]
            wj = q.w[j]
            w = wi + wj + tiny
            safe = wp.max(l, tiny)
            s = c / ((w + inverse_dt2 * springs.compliance[k]) * safe)
            limit = springs.limit[k]
            if limit > S(0.0) and any_less(V(limit * limit) - l2, S(0.0)):
                s = wp.max(s, (l - V(limit)) / (w * safe))
            if wp.static(with_floors):
                floor = springs.floor[k]
                if any_less(l2, floor * floor):
                    s = wp.min(s, (l - V(floor)) / (w * safe))
            q.x[i] = xi - d * (s * wi)
            q.x[j] = xj + d * (s * wj)

    return SimpleNamespace(project_distance=project_distance)
