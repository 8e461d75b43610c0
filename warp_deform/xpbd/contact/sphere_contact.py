"""Contact and friction between particles, from a list of near pairs that is exact by construction.

A pair is listed for a lane when its particles were closer than touching distance + margin at that
lane's last listing; a lane lists anew before its fastest particle can have moved half the margin.
Each lane's mask depends on its own positions only, so a world's bits do not depend on its
neighbours although the lanes share one list.
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
from .friction import friction, friction_adjoint

__all__ = ["sphere_contact", "sphere_contact_adjoint"]


@functools.cache
def sphere_contact(scalar: Any, lanes: int, taped: bool = False) -> SimpleNamespace:
    """`list_near` makes the list of a group, `project_contact` solves one of its pairs.

    It returns whether the pair acted. `taped`, it then leaves its offset d and its step since the
    substep began on the tape.

    A correction may stop an approach, but it separates a pair at `recovery` at most, counting what
    already separates it: an overlap that takes many substeps to undo does not gather speed.
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Pairs, Particles, Near, Watch, Tape = t.Pairs, t.Particles, t.Near, t.Watch, t.Tape
    coulomb_soft = friction(scalar, lanes).coulomb_soft

    @wp.func
    def list_near(
        g: int,
        p0: int,
        start: int,
        capacity: int,
        first: int,
        last: int,
        margin: S,
        stale: V,
        on: V,
        particles: Particles,
        pairs: Pairs,
        near: Near,
        watch: Watch,
        count: int,
    ):
        """Lists the group's near pairs anew from `start` on; returns how many.

        Lanes that are not stale keep the pairs of their own last listing.
        """
        for i in range(p0, p0 + count):
            x = particles.x[i]
            r = particles.xr[i]
            r.x = select(stale, x.x, r.x)
            r.y = select(stale, x.y, r.y)
            r.z = select(stale, x.z, r.z)
            particles.xr[i] = r
        n = int(0)
        zero = V(S(0.0))
        left_out = zero
        for k in range(first, last):
            ij = pairs.ij[k]
            d = particles.xr[p0 + ij[0]] - particles.xr[p0 + ij[1]]
            reach = pairs.distance[k] + margin
            l2 = dot(d, d)
            close = less(l2, V(reach * reach)) * on
            if any_less(zero - close, S(0.0)):
                if n < capacity:
                    near.pair[start + n] = k
                    near.mask[start + n] = close
                    n += 1
                else:
                    left_out = left_out + close
        watch.overflow[g] = wp.max(watch.overflow[g], left_out)
        return n

    @wp.func
    def project_contact(
        k: int,
        p0: int,
        at: int,
        mu: V,
        max_recovery: S,
        particles: Particles,
        pairs: Pairs,
        near: Near,
        tape: Tape,
    ):
        pair = near.pair[k]
        ij = pairs.ij[pair]
        h = pairs.distance[pair]
        i = p0 + ij[0]
        j = p0 + ij[1]
        xi = particles.x[i]
        xj = particles.x[j]
        d = xi - xj
        l2 = dot(d, d)
        zero = V(S(0.0))
        depth = zero
        if any_less(l2, h * h):
            one = V(S(1.0))
            tiny = V(S(1.0e-9))
            l = wp.max(root(l2), tiny)
            n = d * (one / l)
            moved = (xi - particles.xp[i]) - (xj - particles.xp[j])
            approach = dot(moved, n)
            depth = wp.max(V(h) - l, zero) * near.mask[k]
            depth = wp.min(depth, wp.max(V(max_recovery) - approach, zero))
            wi = particles.w[i]
            wj = particles.w[j]
            share = one / wp.max(wi + wj, tiny)
            slip = moved - n * approach
            f = coulomb_soft(dot(slip, slip), depth * mu)
            step = n * (depth * share) - slip * (f * share)
            particles.x[i] = xi + step * wi
            particles.x[j] = xj - step * wj
            if wp.static(taped):
                # what is not listed for a lane's own sake is apart there
                listed = near.mask[k]
                tape.x[at] = V3(
                    select(listed, d.x, V(h + h)),
                    select(listed, d.y, zero),
                    select(listed, d.z, zero),
                )
                tape.x[at + 1] = moved
        return any_less(zero - depth, S(0.0))

    @wp.func
    def touches(
        particle: int,
        lane: int,
        p0: int,
        start: int,
        n: int,
        particles: Particles,
        pairs: Pairs,
        near: Near,
    ):
        """Whether a particle of one lane touches another that it is not exempt from."""
        hit = bool(False)
        for k in range(start, start + n):
            pair = near.pair[k]
            ij = pairs.ij[pair]
            if ij[0] == particle or ij[1] == particle:
                d = particles.x[p0 + ij[0]] - particles.x[p0 + ij[1]]
                h = pairs.distance[pair]
                l2 = dot(d, d)
                if near.mask[k][lane] > S(0.0) and l2[lane] < h * h:
                    hit = True
        return hit

    return SimpleNamespace(list_near=list_near, project_contact=project_contact, touches=touches)


@functools.cache
def sphere_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_contact` takes a pair back that had the offset d and had `moved` since the substep
    began, and returns the derivative by friction.

    Branches: apart or touching; depth limited by the overlap or by `recovery` (then its derivative
    is that of the approach, or 0 while the pair separates as fast as it may).
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Pairs, Adjoint = t.Pairs, t.Adjoint
    coulomb_soft_gradients = friction_adjoint(scalar, lanes).coulomb_soft_gradients

    @wp.func
    def sweep_contact(
        pair: int,
        p0: int,
        d: V3,
        moved: V3,
        mu: V,
        max_recovery: S,
        pairs: Pairs,
        counts: int,
        on: V,
        adj: Adjoint,
    ):
        ij = pairs.ij[pair]
        h = pairs.distance[pair]
        i = p0 + ij[0]
        j = p0 + ij[1]
        zero = V(S(0.0))
        one = V(S(1.0))
        tiny = V(S(1.0e-9))
        exact = root(dot(d, d))
        l = wp.max(exact, tiny)
        inverse = one / l
        n = d * inverse
        approach = dot(moved, n)
        overlap = wp.max(V(h) - l, zero)
        allowed = wp.max(V(max_recovery) - approach, zero)
        depth = wp.min(overlap, allowed)
        acts = less(zero, depth)
        by_mu = zero
        # many pairs separate as fast as they may, in all lanes
        if any_less(zero - acts, S(0.0)):
            wi = adj.w[i]
            wj = adj.w[j]
            share = one / wp.max(wi + wj, tiny)
            slip = moved - n * approach
            budget = depth * mu
            f, by_budget, by_slip2 = coulomb_soft_gradients(dot(slip, slip), budget)
            slowed = less(allowed, overlap) * acts
            kind = counts + wp.static(int(Kind.CONTACT))
            adj.fired[kind] = adj.fired[kind] + acts * on
            kind = counts + wp.static(int(Kind.CONTACT_SLOWED))
            adj.fired[kind] = adj.fired[kind] + slowed * on
            # step = n * (depth * share) - slip * (f * share). Its adjoint is linear in b, the
            # derivative by the step, and as slip is across n, it is a sum of b, slip and n. Their
            # factors are worked out before b is known, for contacts of one particle wait for it.
            held = f * share
            rubs = share * by_budget * mu
            turns = share * by_slip2 * S(2.0)
            parted = less(tiny, exact)
            by_n = inverse * parted
            of_b = by_n * (depth * share + held * approach)
            held_along = held - share * slowed
            rubs_slowed = rubs * slowed
            overlaps = (one - slowed) * parted
            slip_along = by_n * held_along
            slip_across = by_n * (rubs_slowed + turns * approach) - turns
            n_along = held_along - of_b - share * overlaps
            n_across = rubs_slowed + rubs * overlaps
            wi_acts = wi * acts
            wj_acts = wj * acts
            gi = adj.x[i]
            gj = adj.x[j]
            b = gi * wi_acts - gj * wj_acts
            along = dot(n, b)
            across = dot(slip, b)
            g = slip * (along * slip_along + across * slip_across)
            g = b * (of_b - held) + (g + n * (along * n_along + across * n_across))
            adj.x[i] = gi + g
            adj.x[j] = gj - g
            g_moved = n * (along * held_along + across * rubs_slowed) - slip * (across * turns)
            g_moved = g_moved - b * held
            adj.xp[i] = adj.xp[i] - g_moved
            adj.xp[j] = adj.xp[j] + g_moved
            if adj.parts > 0:
                step = n * depth - slip * f
                ei = dot(step, gi)
                ej = dot(step, gj)
                gw = (ej * wj_acts - ei * wi_acts) * (share * share)
                given = share * acts
                adj.mass[i] = adj.mass[i] + select(wi, gw + ei * given, zero)
                adj.mass[j] = adj.mass[j] + select(wj, gw - ej * given, zero)
                by_overlap = (share * along - rubs * across) * (one - slowed)
                adj.radius[i] = adj.radius[i] + by_overlap
                adj.radius[j] = adj.radius[j] + by_overlap
            by_mu = zero - across * share * by_budget * depth
        return by_mu

    return SimpleNamespace(sweep_contact=sweep_contact)
