"""What slows motion inside a fabric: neighbours take on one velocity, but for the piece's turning.

Every pair of neighbours (the ends of a spring) loses a share of its relative velocity, less what it
has because the piece turns as a whole. That mean turning `omega` is the one that leaves the angular
momentum as it is: with the offset d and the relative velocity u of a pair and its reduced mass mu,

    sum mu (|d|^2 - d d^T) omega = sum mu d x u

so that a free piece keeps both momenta, and falls, flies and turns as if there were no viscosity
(compare the damping of Mueller et al., "Position Based Dynamics", 2007, which takes all of a body's
own motion alike). A piece that is held or pinned somewhere hands its turning on to what holds it.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, cross, div, dot, less, mul, select, sub  # noqa: F401
from ..lanes.group_state import group_state

__all__ = ["DAMP_EVERY", "viscosity", "viscosity_adjoint"]

DAMP_EVERY = 4
"""Most substeps between two visits: what is lost in so many is small, and a visit is dear."""


@functools.cache
def viscosity(scalar: Any, lanes: int) -> SimpleNamespace:
    """`damp_fabrics(at, share, on, top, particles, springs)`: all pieces of a group once.

    `mean_turn(first, last, p0, x, v, w, springs)`: how a piece turns as a whole [rad/s].
    """
    t = group_state(scalar, lanes)
    S, V, V3, Span, Topology = t.S, t.V, t.V3, t.Span, t.Topology
    Particles, Springs = t.Particles, t.Springs
    # a piece along a line turns about it at will
    THIN = 1.0e-6 if scalar is wp.float32 else 1.0e-14

    @wp.func
    def mean_turn(
        first: int,
        last: int,
        p0: int,
        x: wp.array(dtype=V3),
        v: wp.array(dtype=V3),
        w: wp.array(dtype=V),
        springs: Springs,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        free = one
        spin = V3(zero, zero, zero)
        square = V3(zero, zero, zero)
        mixed = V3(zero, zero, zero)
        for n in range(first, last):
            ij = springs.neighbours[n]
            i = p0 + ij[0]
            j = p0 + ij[1]
            wi = w[i]
            wj = w[j]
            free = free * less(zero, wi) * less(zero, wj)
            mu = one / (wi + wj + V(S(1.0e-9)))
            d = x[i] - x[j]
            spin = spin + cross(d, v[i] - v[j]) * mu
            m = d * mu
            square = square + V3(m.x * d.x, m.y * d.y, m.z * d.z)
            mixed = mixed + V3(m.y * d.z, m.x * d.z, m.x * d.y)
        # the inverse of a symmetric matrix by its cofactors
        thin = (square.x + square.y + square.z) * S(THIN) + V(S(1.0e-20))
        a = square.y + square.z + thin
        b = square.x + square.z + thin
        c = square.x + square.y + thin
        p = zero - mixed.z
        q = zero - mixed.y
        r = zero - mixed.x
        xx = b * c - r * r
        xy = q * r - p * c
        xz = p * r - b * q
        yz = p * q - a * r
        inverse = free / (a * xx + p * xy + q * xz)
        yy = a * c - q * q
        zz = a * b - p * p
        return V3(
            (xx * spin.x + xy * spin.y + xz * spin.z) * inverse,
            (xy * spin.x + yy * spin.y + yz * spin.z) * inverse,
            (xz * spin.x + yz * spin.y + zz * spin.z) * inverse,
        )

    @wp.func
    def damp_fabrics(
        at: Span, share: S, on: V, top: Topology, particles: Particles, springs: Springs
    ):
        zero = V(S(0.0))
        for i in range(at.p0, at.p0 + at.particles):
            particles.dv[i] = V3(zero, zero, zero)
        for piece in range(top.piece_start[at.k], top.piece_start[at.k + 1]):
            first = springs.neighbour_first[piece]
            last = springs.neighbour_first[piece + 1]
            omega = mean_turn(first, last, at.p0, particles.x, particles.v, particles.w, springs)
            # all pairs lose at once, by the velocities before
            for n in range(first, last):
                ij = springs.neighbours[n]
                i = at.p0 + ij[0]
                j = at.p0 + ij[1]
                wi = particles.w[i]
                wj = particles.w[j]
                u = particles.v[i] - particles.v[j] - cross(omega, particles.x[i] - particles.x[j])
                lost = u * (on * share / (wi + wj + V(S(1.0e-9))))
                particles.dv[i] = particles.dv[i] - lost * wi
                particles.dv[j] = particles.dv[j] + lost * wj
        for i in range(at.p0, at.p0 + at.particles):
            particles.v[i] = particles.v[i] + particles.dv[i]

    return SimpleNamespace(mean_turn=mean_turn, damp_fabrics=damp_fabrics)


@functools.cache
def viscosity_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_damping` leaves position and velocity of every particle on the tape before a visit,
    `sweep_damping` takes it back.

    A visit is v' = v - W A v with the inverse masses W and a symmetric matrix A of the positions.
    So derivatives g by v' become g - A h with h = W g: they are damped as velocities are. With u, r
    = u - omega x d and the lost impulses A v as above, for v and for h, the derivative by d is

        mu (u_h x omega_v + u_v x omega_h - 2 d (omega_h . omega_v) + omega_h (d . omega_v)
            + omega_v (d . omega_h))

    since omega is where the sum of mu |r|^2 is least: mu counts with r_h . r_v alone.
    """
    t = group_state(scalar, lanes)
    S, V, Span, Topology = t.S, t.V, t.Span, t.Topology
    Particles, Springs, Tape, Adjoint = t.Particles, t.Springs, t.Tape, t.Adjoint
    forward = viscosity(scalar, lanes)
    mean_turn, damp_fabrics = forward.mean_turn, forward.damp_fabrics

    @wp.func
    def record_damping(
        at: Span,
        tx: int,
        share: S,
        on: V,
        top: Topology,
        particles: Particles,
        springs: Springs,
        tape: Tape,
    ):
        for i in range(at.particles):
            tape.x[tx + 2 * i] = particles.x[at.p0 + i]
            tape.x[tx + 2 * i + 1] = particles.v[at.p0 + i]
        damp_fabrics(at, share, on, top, particles, springs)

    @wp.func
    def sweep_damping(
        at: Span,
        tx: int,
        share: S,
        on: V,
        top: Topology,
        springs: Springs,
        tape: Tape,
        adj: Adjoint,
    ):
        zero = V(S(0.0))
        for k in range(at.particles):
            i = at.p0 + k
            adj.then_x[i] = tape.x[tx + 2 * k]
            adj.then_v[i] = tape.x[tx + 2 * k + 1]
            adj.then_g[i] = adj.v[i]
            adj.then_h[i] = adj.v[i] * adj.w[i]
        for piece in range(top.piece_start[at.k], top.piece_start[at.k + 1]):
            first = springs.neighbour_first[piece]
            last = springs.neighbour_first[piece + 1]
            ov = mean_turn(first, last, at.p0, adj.then_x, adj.then_v, adj.w, springs)
            oh = mean_turn(first, last, at.p0, adj.then_x, adj.then_h, adj.w, springs)
            turns = dot(oh, ov) * S(2.0)
            for n in range(first, last):
                ij = springs.neighbours[n]
                i = at.p0 + ij[0]
                j = at.p0 + ij[1]
                wi = adj.w[i]
                wj = adj.w[j]
                inverse = V(S(1.0)) / (wi + wj + V(S(1.0e-9)))
                mu = on * share * inverse
                d = adj.then_x[i] - adj.then_x[j]
                uv = adj.then_v[i] - adj.then_v[j]
                uh = adj.then_h[i] - adj.then_h[j]
                rv = uv - cross(ov, d)
                rh = uh - cross(oh, d)
                adj.v[i] = adj.v[i] - rh * mu
                adj.v[j] = adj.v[j] + rh * mu
                gd = cross(uh, ov) + cross(uv, oh) - d * turns + oh * dot(d, ov) + ov * dot(d, oh)
                gd = gd * mu
                adj.x[i] = adj.x[i] + gd
                adj.x[j] = adj.x[j] - gd
                both = dot(rh, rv) * mu * inverse
                gi = both - dot(adj.then_g[i], rv) * mu
                gj = both + dot(adj.then_g[j], rv) * mu
                adj.mass[i] = adj.mass[i] + select(wi, gi, zero)
                adj.mass[j] = adj.mass[j] + select(wj, gj, zero)

    return SimpleNamespace(record_damping=record_damping, sweep_damping=sweep_damping)
