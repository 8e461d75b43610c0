"""Chains of springs solved directly: a pull reaches the far end within the substep.

A chain is a run of springs each of which begins where the one before ended. One iteration over its
springs carries a pull one of them further, so a long chain would hang as if made of springs of m /
dt^2. Here the multipliers of XPBD's equation 18 are those of all springs at once: with directions
n_k, lengths l_k and the particle j between the springs k and k + 1,

    A lambda = l - L,    A_kk = w_i + w_j + a_k / dt^2,    A_k,k+1 = -w_j n_k . n_k+1

A is symmetric, positive definite and tridiagonal: one elimination and one substitution (Thomas).
Source: Deul, Kugelstadt, Weiler, Bender, "Direct Position-Based Solver for Stiff Rods", 2018.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["chain", "chain_adjoint"]

BOUNDS = 3
"""How often springs beyond their bounds are looked for: those held there load their neighbours."""


@functools.cache
def chain(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_chain(k, count, p0, inverse_dt2, particles, springs, lines)`: solve the `count`
    springs from `k` on. `measure` takes in the offset of one of them, `solve_chain` leaves their
    multipliers in `lines`.

    What would be beyond its strain limit, or is below its floor and would stay so, is brought just
    there instead, as a rigid rod: a solution finds these springs, and all is solved anew.
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Particles, Springs, Lines = t.Particles, t.Springs, t.Lines

    @wp.func
    def measure(i: int, d: V3, rest: S, lines: Lines):
        l = root(dot(d, d))
        lines.along[i] = d * (V(S(1.0)) / wp.max(l, V(S(1.0e-9))))
        lines.length[i] = l
        lines.target[i] = V(rest)
        lines.elastic[i] = V(S(1.0))

    @wp.func
    def eliminate(
        k: int,
        count: int,
        p0: int,
        inverse_dt2: V,
        w: wp.array(dtype=V),
        springs: Springs,
        lines: Lines,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        off = zero
        ratio = zero
        rest = zero
        multiplier = zero
        along = lines.along[p0 + springs.ij[k][0]]
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            soft = inverse_dt2 * springs.compliance[s] * lines.elastic[i]
            wj = w[p0 + ij[1]]
            pivot = w[i] + wj + soft + V(S(1.0e-9)) - off * ratio
            inverse = one / pivot
            rest = lines.length[i] - lines.target[i] - ratio * rest
            multiplier = rest * inverse
            if s + 1 < k + count:
                here = along
                along = lines.along[p0 + ij[1]]
                off = zero - wj * dot(here, along)
                ratio = off * inverse
            lines.inverse[i] = inverse
            lines.ratio[i] = ratio
            lines.multiplier[i] = multiplier
        # from the end, which has its own already
        for r in range(1, count):
            i = p0 + springs.ij[k + count - 1 - r][0]
            multiplier = lines.multiplier[i] - lines.ratio[i] * multiplier
            lines.multiplier[i] = multiplier

    @wp.func
    def bound(k: int, count: int, p0: int, inverse_dt2: V, springs: Springs, lines: Lines):
        zero = V(S(0.0))
        bounded = bool(False)
        for s in range(k, k + count):
            i = p0 + springs.ij[s][0]
            length = lines.length[i]
            left = lines.target[i] + inverse_dt2 * springs.compliance[s] * lines.multiplier[i]
            limit = springs.limit[s]
            if limit > S(0.0):
                beyond = less(V(limit), left) * lines.elastic[i]
                if any_less(zero - beyond, S(0.0)):
                    bounded = True
                lines.target[i] = select(beyond, V(limit), lines.target[i])
                lines.elastic[i] = select(beyond, zero, lines.elastic[i])
            # what is above its floor now may go below for a substep: bounding it already would
            # push, and neighbours would push each other to and fro
            floor = springs.floor[s]
            if any_less(length - V(floor), S(0.0)):
                below = less(wp.max(left, length), V(floor)) * lines.elastic[i]
                if any_less(zero - below, S(0.0)):
                    bounded = True
                lines.target[i] = select(below, V(floor), lines.target[i])
                lines.elastic[i] = select(below, zero, lines.elastic[i])
        return bounded

    @wp.func
    def solve_chain(
        k: int,
        count: int,
        p0: int,
        inverse_dt2: V,
        w: wp.array(dtype=V),
        springs: Springs,
        lines: Lines,
    ):
        eliminate(k, count, p0, inverse_dt2, w, springs, lines)
        if springs.limit[k] > S(0.0) or springs.floor[k] > S(0.0):
            r = int(0)
            while r < wp.static(BOUNDS):
                r += 1
                if bound(k, count, p0, inverse_dt2, springs, lines):
                    eliminate(k, count, p0, inverse_dt2, w, springs, lines)
                else:
                    r = wp.static(BOUNDS)

    @wp.func
    def project_chain(
        k: int,
        count: int,
        p0: int,
        inverse_dt2: V,
        particles: Particles,
        springs: Springs,
        lines: Lines,
    ):
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            measure(i, particles.x[i] - particles.x[p0 + ij[1]], springs.length[s], lines)
        solve_chain(k, count, p0, inverse_dt2, particles.w, springs, lines)
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + ij[1]
            pull = lines.along[i] * lines.multiplier[i]
            particles.x[i] = particles.x[i] - pull * particles.w[i]
            particles.x[j] = particles.x[j] + pull * particles.w[j]

    return SimpleNamespace(measure=measure, solve_chain=solve_chain, project_chain=project_chain)


@functools.cache
def chain_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_chain` solves a chain and leaves the offset d of each spring on the tape,
    `sweep_chain` takes it back: the derivatives by the particles, inverse masses, the springs' own
    (from `own` on) and `inverse_dt2` (returned). Branch: elastic, or at its strain limit or floor.

    With lambda = A^-1 c and g the derivatives by lambda, mu = A^-1 g are those by c, and those by A
    are -mu lambda^T. The factors of A are made again from the offsets.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V
    Particles, Springs, Lines = t.Particles, t.Springs, t.Lines
    Tape, Adjoint = t.Tape, t.Adjoint
    chain_ = chain(scalar, lanes)
    measure, solve_chain, project_chain = chain_.measure, chain_.solve_chain, chain_.project_chain

    @wp.func
    def record_chain(
        k: int,
        count: int,
        p0: int,
        at: int,
        inverse_dt2: V,
        particles: Particles,
        springs: Springs,
        lines: Lines,
        tape: Tape,
    ):
        for r in range(count):
            ij = springs.ij[k + r]
            tape.x[at + r] = particles.x[p0 + ij[0]] - particles.x[p0 + ij[1]]
        project_chain(k, count, p0, inverse_dt2, particles, springs, lines)

    @wp.func
    def turn_around(
        k: int, count: int, p0: int, inverse_dt2: V, springs: Springs, lines: Lines, adj: Adjoint
    ):
        """Leave mu in `lines`, from the factors that are there."""
        zero = V(S(0.0))
        ratio = zero
        rest = zero
        turned = zero
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + ij[1]
            g = dot(lines.along[i], adj.x[j] * adj.w[j] - adj.x[i] * adj.w[i])
            rest = g - ratio * rest
            ratio = lines.ratio[i]
            turned = rest * lines.inverse[i]
            lines.turned[i] = turned
        for r in range(1, count):
            i = p0 + springs.ij[k + count - 1 - r][0]
            turned = lines.turned[i] - lines.ratio[i] * turned
            lines.turned[i] = turned

    @wp.func
    def sweep_chain(
        k: int,
        own: int,
        count: int,
        p0: int,
        at: int,
        inverse_dt2: V,
        springs: Springs,
        lines: Lines,
        counts: int,
        on: V,
        tape: Tape,
        adj: Adjoint,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        tiny = V(S(1.0e-9))
        for r in range(count):
            measure(p0 + springs.ij[k + r][0], tape.x[at + r], springs.length[k + r], lines)
        solve_chain(k, count, p0, inverse_dt2, adj.w, springs, lines)
        turn_around(k, count, p0, inverse_dt2, springs, lines, adj)
        by_inverse_dt2 = zero
        # of the coupling with the spring before
        by_off = zero
        gi = adj.x[p0 + springs.ij[k][0]]
        before = lines.along[p0 + springs.ij[k][0]]
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + ij[1]
            wi = adj.w[i]
            wj = adj.w[j]
            gj = adj.x[j]
            n = lines.along[i]
            multiplier = lines.multiplier[i]
            turned = lines.turned[i]
            by_along = (gj * wj - gi * wi) * multiplier - before * (wi * by_off)
            by_diagonal = zero - turned * multiplier
            by_wj = by_diagonal + multiplier * dot(n, gj)
            kind = counts + wp.static(int(Kind.STRAIN_LIMIT))
            adj.fired[kind] = adj.fired[kind] + (one - lines.elastic[i]) * on
            elastic = lines.elastic[i]
            by_inverse_dt2 = by_inverse_dt2 + by_diagonal * springs.compliance[s] * elastic
            at_own = own + s - k
            adj.softness[at_own] = adj.softness[at_own] + by_diagonal * elastic
            # a limit and a floor are shares of the rest length, and move with it
            share = lines.target[i] * (S(1.0) / springs.length[s])
            adj.rest[at_own] = adj.rest[at_own] - turned * share
            adj.mass[i] = adj.mass[i] + select(wi, by_diagonal - multiplier * dot(n, gi), zero)
            if s + 1 < k + count:
                after = lines.along[j]
                by_off = zero - (turned * lines.multiplier[j] + lines.turned[j] * multiplier)
                by_along = by_along - after * (wj * by_off)
                by_wj = by_wj - dot(n, after) * by_off
            adj.mass[j] = adj.mass[j] + select(wj, by_wj, zero)
            l = lines.length[i]
            # at length 0 the spring has no direction, and none to turn to
            across = (by_along - n * dot(n, by_along)) * (less(tiny, l) / wp.max(l, tiny))
            by_d = n * turned + across
            adj.x[i] = adj.x[i] + by_d
            adj.x[j] = gj - by_d
            gi = gj
            before = n
        return by_inverse_dt2

    return SimpleNamespace(record_chain=record_chain, sweep_chain=sweep_chain)
