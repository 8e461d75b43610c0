"""Bending springs of an open chain solved directly: it is as stiff as a beam within the substep.

A beam is a run of bending springs without an offset at rest (`bending` with h = 0), each of which
bends the next particle. Their offsets d_k = x_j - (x_i + x_e) / 2 are linear in the positions, so
the multipliers of XPBD's equation 18 of all of them follow, alike for x, y and z, from

    A lambda = d,    A_kk = w_j + (w_i + w_e) / 4 + a_k / dt^2,
    A_k,k+1 = -(w_j + w_e) / 2,    A_k,k+2 = w_e / 4

where spring k bends particle j between i and e. A is symmetric and positive definite with two
diagonals on either side: A = L D L^T, one elimination and one substitution.
Source: Golub, Van Loan, "Matrix Computations", section 4.3 (banded systems).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, div, dot, mul, select, sub  # noqa: F401  (operators by name)
from ..lanes.structures import structures

__all__ = ["beam", "beam_adjoint"]


@functools.cache
def beam(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_beam(k, count, p0, inverse_dt2, particles, springs, lines)`: solve the `count`
    bending springs from `k` on.

    `factor` leaves L and 1 / D in `lines`; `substitute` puts the solution in place of the right
    side, `lines.bend`.
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Particles, Springs, Lines = t.Particles, t.Springs, t.Lines

    @wp.func
    def factor(
        k: int,
        count: int,
        p0: int,
        inverse_dt2: V,
        w: wp.array(dtype=V),
        springs: Springs,
        lines: Lines,
    ):
        zero = V(S(0.0))
        # entries of L one and two below the diagonal, of the two columns before, and times D
        next1 = zero
        next1_d = zero
        after1_d = zero
        after2 = zero
        after2_d = zero
        after1 = zero
        for s in range(k, k + count):
            ij = springs.ij[s]
            j = p0 + springs.middle[s]
            wj = w[j]
            we = w[p0 + ij[1]]
            soft = inverse_dt2 * springs.compliance[s]
            diagonal = wj + (w[p0 + ij[0]] + we) * S(0.25) + soft + V(S(1.0e-9))
            inverse = V(S(1.0)) / (diagonal - next1 * next1_d - after2 * after2_d)
            next1_d = zero - (wj + we) * S(0.5) - next1 * after1_d
            next1 = next1_d * inverse
            after2 = after1
            after2_d = after1_d
            after1_d = we * S(0.25)
            after1 = after1_d * inverse
            lines.inverse[j] = inverse
            lines.ratio[j] = next1
            lines.ratio2[j] = after1

    @wp.func
    def substitute(k: int, count: int, p0: int, springs: Springs, lines: Lines):
        none = V3(V(S(0.0)), V(S(0.0)), V(S(0.0)))
        next1 = V(S(0.0))
        after1 = V(S(0.0))
        after2 = V(S(0.0))
        one_before = none
        two_before = none
        for s in range(k, k + count):
            j = p0 + springs.middle[s]
            here = lines.bend[j] - one_before * next1 - two_before * after2
            two_before = one_before
            one_before = here
            next1 = lines.ratio[j]
            after2 = after1
            after1 = lines.ratio2[j]
            lines.bend[j] = here * lines.inverse[j]
        one_after = none
        two_after = none
        for r in range(count):
            j = p0 + springs.middle[k + count - 1 - r]
            here = lines.bend[j] - one_after * lines.ratio[j] - two_after * lines.ratio2[j]
            two_after = one_after
            one_after = here
            lines.bend[j] = here

    @wp.func
    def project_beam(
        k: int,
        count: int,
        p0: int,
        inverse_dt2: V,
        particles: Particles,
        springs: Springs,
        lines: Lines,
    ):
        half = S(0.5)
        for s in range(k, k + count):
            ij = springs.ij[s]
            j = p0 + springs.middle[s]
            ends = particles.x[p0 + ij[0]] + particles.x[p0 + ij[1]]
            lines.bend[j] = particles.x[j] - ends * half
        factor(k, count, p0, inverse_dt2, particles.w, springs, lines)
        substitute(k, count, p0, springs, lines)
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + springs.middle[s]
            e = p0 + ij[1]
            pull = lines.bend[j]
            particles.x[i] = particles.x[i] + pull * (particles.w[i] * half)
            particles.x[e] = particles.x[e] + pull * (particles.w[e] * half)
            particles.x[j] = particles.x[j] - pull * particles.w[j]

    return SimpleNamespace(factor=factor, substitute=substitute, project_beam=project_beam)


@functools.cache
def beam_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_beam` solves a beam and leaves the offset d of each spring on the tape, `sweep_beam`
    takes it back: the derivatives by the particles, inverse masses, the springs' own (from `own`
    on) and `inverse_dt2` (returned).

    As in `chain`: with g the derivatives by lambda, mu = A^-1 g are those by d, and those by A are
    -mu lambda^T.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V
    Particles, Springs, Lines = t.Particles, t.Springs, t.Lines
    Tape, Adjoint = t.Tape, t.Adjoint
    beam_ = beam(scalar, lanes)
    factor, substitute, project_beam = beam_.factor, beam_.substitute, beam_.project_beam

    @wp.func
    def record_beam(
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
            ends = particles.x[p0 + ij[0]] + particles.x[p0 + ij[1]]
            tape.x[at + r] = particles.x[p0 + springs.middle[k + r]] - ends * S(0.5)
        project_beam(k, count, p0, inverse_dt2, particles, springs, lines)

    @wp.func
    def add_mass(i: int, amount: V, adj: Adjoint):
        adj.mass[i] = adj.mass[i] + select(adj.w[i], amount, V(S(0.0)))

    @wp.func
    def sweep_beam(
        k: int,
        own: int,
        count: int,
        p0: int,
        at: int,
        inverse_dt2: V,
        springs: Springs,
        lines: Lines,
        tape: Tape,
        adj: Adjoint,
    ):
        half = S(0.5)
        quarter = S(0.25)
        zero = V(S(0.0))
        for r in range(count):
            lines.bend[p0 + springs.middle[k + r]] = tape.x[at + r]
        factor(k, count, p0, inverse_dt2, adj.w, springs, lines)
        substitute(k, count, p0, springs, lines)
        for s in range(k, k + count):
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + springs.middle[s]
            e = p0 + ij[1]
            gi = adj.x[i]
            gj = adj.x[j]
            ge = adj.x[e]
            pull = lines.bend[j]
            lines.along[j] = pull
            add_mass(i, dot(pull, gi) * half, adj)
            add_mass(e, dot(pull, ge) * half, adj)
            add_mass(j, zero - dot(pull, gj), adj)
            lines.bend[j] = (gi * adj.w[i] + ge * adj.w[e]) * half - gj * adj.w[j]
        substitute(k, count, p0, springs, lines)
        by_inverse_dt2 = zero
        for r in range(count):
            s = k + r
            ij = springs.ij[s]
            i = p0 + ij[0]
            j = p0 + springs.middle[s]
            e = p0 + ij[1]
            pull = lines.along[j]
            turned = lines.bend[j]
            by_diagonal = zero - dot(turned, pull)
            by_inverse_dt2 = by_inverse_dt2 + by_diagonal * springs.compliance[s]
            adj.softness[own + r] = adj.softness[own + r] + by_diagonal
            by_wj = by_diagonal
            by_we = by_diagonal * quarter
            if r + 1 < count:
                by_next = (dot(turned, lines.along[e]) + dot(lines.bend[e], pull)) * half
                by_wj = by_wj + by_next
                by_we = by_we + by_next
            if r + 2 < count:
                far = p0 + springs.middle[s + 2]
                by_after = dot(turned, lines.along[far]) + dot(lines.bend[far], pull)
                by_we = by_we - by_after * quarter
            add_mass(i, by_diagonal * quarter, adj)
            add_mass(j, by_wj, adj)
            add_mass(e, by_we, adj)
            back = turned * half
            adj.x[i] = adj.x[i] - back
            adj.x[e] = adj.x[e] - back
            adj.x[j] = adj.x[j] + turned
        return by_inverse_dt2

    return SimpleNamespace(record_beam=record_beam, sweep_beam=sweep_beam)
