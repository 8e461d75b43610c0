"""What the guards look at inside the kernel: the worst values of a launch, world by world."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.box_overlap import box_overlap
from ..lanes.algebra import add, length, mul, nonfinite, sub  # noqa: F401  (operators are found by name)
from ..lanes.group_state import group_state

__all__ = ["watch"]


@functools.cache
def watch(scalar: Any, lanes: int, with_bodies: bool) -> SimpleNamespace:
    """`watch_group(at, ...)`: a look at all worlds of a group."""
    t = group_state(scalar, lanes)
    S, V, L, Span = t.S, t.V, t.L, t.Span
    Springs, Particles, Bodies, Watch = t.Springs, t.Particles, t.Bodies, t.Watch
    Shapes, Group = t.Shapes, t.Group
    boxes = box_overlap(scalar, lanes)
    overlap_share, corner_depth = boxes.overlap_share, boxes.corner_depth

    @wp.func
    def watch_boxes(
        g: int,
        lane: int,
        b0: int,
        first: int,
        last: int,
        shapes: Shapes,
        bodies: Bodies,
        watch: Watch,
    ):
        """Worst depths of the boxes of one lane, whose bodies begin at b0.

        What has no mass is scenery and may stand in the table and in other scenery. What is held
        has a mass: the path that it is led along is to blame.
        """
        depth = S(0.0)
        share = S(0.0)
        for sa in range(first, last):
            a = b0 + shapes.body[sa]
            if bodies.w0[a] > S(0.0):
                depth = wp.max(depth, corner_depth(sa, a, shapes, bodies))
            for sb in range(sa + 1, last):
                b = b0 + shapes.body[sb]
                if a != b and bodies.w0[a] + bodies.w0[b] > S(0.0):
                    share = wp.max(share, overlap_share(sa, a, sb, b, shapes, bodies))
        depths = watch.box_depth[g]
        depths[lane] = wp.max(depths[lane], depth)
        watch.box_depth[g] = depths
        shares = watch.box_overlap[g]
        shares[lane] = wp.max(shares[lane], share)
        watch.box_overlap[g] = shares

    @wp.func
    def watch_group(
        at: Span,
        springs: Springs,
        shapes: Shapes,
        group: Group,
        particles: Particles,
        bodies: Bodies,
        watch: Watch,
    ):
        """Worst values of the guards, once every `check_every` substeps."""
        g = at.g
        p0 = at.p0
        n = at.particles
        b0 = at.b0
        body_count = at.bodies
        zero = V(S(0.0))
        bad = watch.nonfinite[g]
        lowest = V(S(1.0e9))
        for i in range(p0, p0 + n):
            x = particles.x[i]
            bad = wp.max(bad, nonfinite(x.x + x.y + x.z))
            lowest = wp.min(lowest, x.z)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                for b in range(b0 + lane * body_count, b0 + (lane + 1) * body_count):
                    sum = bodies.x[b] + bodies.omega[b]
                    turn = bodies.q[b]
                    if not wp.isfinite(
                        sum[0] + sum[1] + sum[2] + turn[0] + turn[1] + turn[2] + turn[3]
                    ):
                        bad[lane] = S(1.0)
            on = group.active[g]
            for lane in range(wp.static(L)):
                # depths of what is no number mean nothing
                if on[lane] > S(0.0) and bad[lane] == S(0.0):
                    first = at.shape0 + lane * at.shapes
                    watch_boxes(
                        g,
                        lane,
                        b0 + lane * body_count,
                        first,
                        first + at.shapes,
                        shapes,
                        bodies,
                        watch,
                    )
        watch.nonfinite[g] = bad
        watch.depth[g] = wp.max(watch.depth[g], wp.max(zero - lowest, zero))
        stretch = watch.stretch[g]
        for s in range(at.s0, at.s1):
            if springs.watched[s] > 0:
                ij = springs.ij[s]
                l = length(particles.x[p0 + ij[0]] - particles.x[p0 + ij[1]])
                stretch = wp.max(stretch, l * (S(1.0) / springs.length[s]))
        watch.stretch[g] = stretch

    return SimpleNamespace(watch_group=watch_group)
