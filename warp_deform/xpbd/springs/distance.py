"""Distance constraints: links, fold limits, tension-only diagonals, bending across a joint.

Source: Macklin, Mueller, Chentanez, "XPBD", 2016, equation 18 with one iteration a substep. A
spring of stiffness k has compliance 1 / k, so it converges to Hooke's law as the substep shrinks.
Bending is a soft spring between second neighbours (or across a shared edge).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import (  # noqa: F401  (operators are found by name)
    add,
    any_less,
    div,
    dot,
    less,
    mul,
    root,
    select,
    sub,
)
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["distance", "distance_adjoint"]


@functools.cache
def distance(
    scalar: Any, lanes: int, with_floors: bool = False, taped: bool = False
) -> SimpleNamespace:
    """`project_distance(k, p0, at, inverse_dt2, particles, springs, tape)`: solve spring `k`.

    It returns whether the spring acted. `taped`, it leaves its offset d on the tape.

    For a two-sided spring (mode 0) of length l, rest length L and compliance a,
    ``lambda = (l - L) / (wi + wj + a / dt^2)`` moves both ends along the spring. AT_LEAST (mode 1)
    acts only when l < L, AT_MOST (mode 2) only when l > L. With a strain limit X the correction is
    at least the rigid one for l > X, in the same solve; with a floor (and `with_floors`), it is so
    for l < floor as well, whatever the mode.
    """
    t = structures(scalar, lanes)
    S, V, Particles, Springs, Tape = t.S, t.V, t.Particles, t.Springs, t.Tape

    @wp.func
    def project_distance(
        k: int, p0: int, at: int, inverse_dt2: V, particles: Particles, springs: Springs, tape: Tape
    ):
        ij = springs.ij[k]
        i = p0 + ij[0]
        j = p0 + ij[1]
        rest = springs.length[k]
        mode = springs.mode[k]
        xi = particles.x[i]
        xj = particles.x[j]
        d = xi - xj
        if wp.static(taped):
            tape.x[at] = d
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
            wi = particles.w[i]
            wj = particles.w[j]
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
            particles.x[i] = xi - d * (s * wi)
            particles.x[j] = xj + d * (s * wj)
        return acts

    return SimpleNamespace(project_distance=project_distance)


@functools.cache
def distance_adjoint(scalar: Any, lanes: int, with_floors: bool = False) -> SimpleNamespace:
    """`sweep_distance` takes a spring of offset d back: the derivatives by both ends, inverse
    masses, the spring's own (at `own`) and `inverse_dt2` (returned).

    The correction is s d with s = (l - target) / (D l); whichever of the rest length, the strain
    limit and the floor decided s is the target, and D is the sum of inverse masses plus, for the
    rest length, the compliance. So ds/dl = target / (D l^2), ds/dD = -s / D and ds/dtarget =
    -1 / (D l). A limit and a floor are shares of the rest length, and move with it.
    """
    t = structures(scalar, lanes)
    S, V, V3, Springs, Adjoint = t.S, t.V, t.V3, t.Springs, t.Adjoint

    @wp.func
    def sweep_distance(
        k: int,
        own: int,
        p0: int,
        d: V3,
        inverse_dt2: V,
        springs: Springs,
        counts: int,
        on: V,
        adj: Adjoint,
    ):
        ij = springs.ij[k]
        i = p0 + ij[0]
        j = p0 + ij[1]
        rest = springs.length[k]
        mode = springs.mode[k]
        l2 = dot(d, d)
        zero = V(S(0.0))
        one = V(S(1.0))
        tiny = V(S(1.0e-9))
        l = root(l2)
        c = l - V(rest)
        acts = one
        if mode == 1:
            c = wp.min(c, zero)
            acts = less(c, zero)
            kind = counts + wp.static(int(Kind.FOLD_LIMIT))
            adj.fired[kind] = adj.fired[kind] + acts * on
        elif mode == 2:
            c = wp.max(c, zero)
            acts = less(zero, c)
        wi = adj.w[i]
        wj = adj.w[j]
        w = wi + wj + tiny
        safe = wp.max(l, tiny)
        soft = one * springs.compliance[k]
        below = w + inverse_dt2 * soft
        inverse = one / (below * safe)
        s = c * inverse
        target = V(rest)
        elastic = one
        limit = springs.limit[k]
        if limit > S(0.0) and any_less(V(limit * limit) - l2, S(0.0)):
            # compared as in the forward pass; what is not tight keeps the bits it has alone
            other = (l - V(limit)) / (w * safe)
            tight = less(c / (below * safe), other)
            kind = counts + wp.static(int(Kind.STRAIN_LIMIT))
            adj.fired[kind] = adj.fired[kind] + tight * on
            s = select(tight, other, s)
            acts = wp.max(acts, tight)
            target = select(tight, V(limit), target)
            below = select(tight, w, below)
            soft = select(tight, zero, soft)
            elastic = select(tight, zero, elastic)
            inverse = one / (below * safe)
        if wp.static(with_floors):
            floor = springs.floor[k]
            if any_less(l2, floor * floor):
                other = (l - V(floor)) / (w * safe)
                tight = less(other, (l - target) * acts / (below * safe))
                kind = counts + wp.static(int(Kind.STRAIN_LIMIT))
                adj.fired[kind] = adj.fired[kind] + tight * on
                s = select(tight, other, s)
                acts = wp.max(acts, tight)
                target = select(tight, V(floor), target)
                below = select(tight, w, below)
                soft = select(tight, zero, soft)
                elastic = select(tight, zero, elastic)
                inverse = one / (below * safe)
        gi = adj.x[i]
        gj = adj.x[j]
        b = gj * wj - gi * wi
        di = dot(d, gi)
        dj = dot(d, gj)
        gs = dj * wj - di * wi
        # at length 0 the spring has no direction, and none to turn to
        along = inverse * below
        by_length = target * (less(tiny, l) * acts) * inverse * (along * along)
        gd = b * s + d * (gs * by_length)
        adj.x[i] = gi + gd
        adj.x[j] = gj - gd
        gw = gs * (zero - acts * s * inverse * safe)
        if adj.parts > 0:
            adj.mass[i] = adj.mass[i] + select(wi, gw - s * di, zero)
            adj.mass[j] = adj.mass[j] + select(wj, gw + s * dj, zero)
            adj.softness[own] = adj.softness[own] + gw * elastic
            adj.rest[own] = adj.rest[own] - gs * (acts * inverse * target) * (S(1.0) / rest)
        return gw * soft

    return SimpleNamespace(sweep_distance=sweep_distance)
