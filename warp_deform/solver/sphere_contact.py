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

from .friction import friction
from .lanes import (  # noqa: F401  (operators are found by name)
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
from .structures import structures

__all__ = ["sphere_contact"]


@functools.cache
def sphere_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`list_near` makes the list of a group, `project_contact` solves one of its pairs.

    A correction may stop an approach, but it separates a pair at `recovery` at most, counting what
    already separates it: an overlap that takes many substeps to undo does not gather speed.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V
    Pairs, Particles, Near, Watch = t.Pairs, t.Particles, t.Near, t.Watch
    coulomb_soft = friction(scalar, lanes).coulomb_soft

    @wp.func
    def list_near(
        g: int, p0: int, start: int, capacity: int, first: int, last: int, margin: S, stale: V,
        on: V, q: Particles, pairs: Pairs, near: Near, watch: Watch, count: int,
    ):  # fmt: skip
        """Lists the group's near pairs anew from `start` on; returns how many.

        Lanes that are not stale keep the pairs of their own last listing.
        """
        for i in range(p0, p0 + count):
            x = q.x[i]
            r = q.xr[i]
            r.x = select(stale, x.x, r.x)
            r.y = select(stale, x.y, r.y)
            r.z = select(stale, x.z, r.z)
            q.xr[i] = r
        n = int(0)
        zero = V(S(0.0))
        left_out = zero
        for k in range(first, last):
            ij = pairs.ij[k]
            d = q.xr[p0 + ij[0]] - q.xr[p0 + ij[1]]
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
    def project_contact(k: int, p0: int, mu: V, push: S, q: Particles, pairs: Pairs, near: Near):
        pair = near.pair[k]
        ij = pairs.ij[pair]
        h = pairs.distance[pair]
        i = p0 + ij[0]
        j = p0 + ij[1]
        xi = q.x[i]
        xj = q.x[j]
        d = xi - xj
        l2 = dot(d, d)
        if any_less(l2, h * h):
            zero = V(S(0.0))
            one = V(S(1.0))
            tiny = V(S(1.0e-9))
            l = wp.max(root(l2), tiny)
            n = d * (one / l)
            moved = (xi - q.xp[i]) - (xj - q.xp[j])
            approach = dot(moved, n)
            depth = wp.max(V(h) - l, zero) * near.mask[k]
            depth = wp.min(depth, wp.max(V(push) - approach, zero))
            wi = q.w[i]
            wj = q.w[j]
            share = one / wp.max(wi + wj, tiny)
            slip = moved - n * approach
            f = coulomb_soft(dot(slip, slip), depth * mu)
            step = n * (depth * share) - slip * (f * share)
            q.x[i] = xi + step * wi
            q.x[j] = xj - step * wj

    @wp.func
    def touches(
        particle: int, lane: int, p0: int, start: int, n: int, q: Particles, pairs: Pairs,
        near: Near,
    ):  # fmt: skip
        """Whether a particle of one lane touches another that it is not exempt from."""
        hit = bool(False)
        for k in range(start, start + n):
            pair = near.pair[k]
            ij = pairs.ij[pair]
            if ij[0] == particle or ij[1] == particle:
                d = q.x[p0 + ij[0]] - q.x[p0 + ij[1]]
                h = pairs.distance[pair]
                l2 = dot(d, d)
                if near.mask[k][lane] > S(0.0) and l2[lane] < h * h:
                    hit = True
        return hit

    return SimpleNamespace(list_near=list_near, project_contact=project_contact, touches=touches)
