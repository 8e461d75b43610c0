"""How a launch begins and ends: what is gripped becomes kinematic, and is let go."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...objects.push import MOST_PUSHES
from ..lanes.algebra import add, sub  # noqa: F401  (operators are found by name)
from ..lanes.group_state import group_state
from ..springs.sleep import sleep
from .grip import grip

__all__ = ["launch_ends"]


@functools.cache
def launch_ends(
    scalar: Any, lanes: int, with_bodies: bool, with_sheets: bool, taped: bool
) -> SimpleNamespace:
    """`begin` takes what is gripped and returns a group's `Run` before its first substep;
    `record_frame` notes where everything is; `end` lets go of what is still held.
    """
    t = group_state(scalar, lanes)
    S, V, V3, L = t.S, t.V, t.V3, t.L
    Span, Run, Settings, Group, Particles = t.Span, t.Run, t.Settings, t.Group, t.Particles
    Bodies, Grips, Watch, Cells, Tape = t.Bodies, t.Grips, t.Watch, t.Cells, t.Tape
    take, let_go = grip(scalar, lanes).take, grip(scalar, lanes).let_go
    rouse = sleep(scalar, lanes).rouse

    @wp.func
    def begin(
        at: Span,
        st: Settings,
        group: Group,
        particles: Particles,
        bodies: Bodies,
        grips: Grips,
        cells: Cells,
    ):
        zero = V(S(0.0))
        run = Run()
        run.on = group.active[at.g]
        run.steps = zero
        run.quiet = zero
        run.calm = group.calm_steps[at.g]
        run.stale = run.on
        run.fresh = zero
        run.travel = zero
        run.clamped = zero
        run.free_time = zero
        run.least = group.least_steps[at.g]
        run.drift = V3(zero, zero, zero)
        run.substep = int(0)
        run.near_count = int(0)
        if wp.static(with_sheets):
            rouse(at, run.on, st, particles)
        holding = zero
        longest = int(0)
        for lane in range(wp.static(L)):
            world = at.world0 + lane
            if wp.static(with_sheets):
                cells.met[world] = 0
            if run.on[lane] > S(0.0):
                if grips.particle[world] >= 0 or grips.body[world] >= 0:
                    holding[lane] = S(1.0)
                    take(world, lane, at.p0, at.b0 + lane * at.bodies, particles, bodies, grips)
                for p in range(wp.static(MOST_PUSHES)):
                    slot = world * wp.static(MOST_PUSHES) + p
                    if grips.push[slot] >= 0:
                        longest = wp.max(longest, grips.push_steps[slot])
        run.holding = holding
        run.longest_push = longest
        return run

    @wp.func
    def record_frame(
        at: Span, frame: int, st: Settings, particles: Particles, bodies: Bodies, watch: Watch
    ):
        for i in range(at.particles):
            watch.frame_x[frame * st.particle_stride + at.p0 + i] = particles.x[at.p0 + i]
        if wp.static(with_bodies):
            for b in range(at.bodies * wp.static(L)):
                row = frame * st.body_stride + at.b0 + b
                watch.frame_body_x[row] = bodies.x[at.b0 + b]
                watch.frame_body_q[row] = bodies.q[at.b0 + b]

    @wp.func
    def end(
        at: Span,
        run: Run,
        ends: bool,
        tops: wp.vec4i,
        particles: Particles,
        bodies: Bodies,
        grips: Grips,
        cells: Cells,
        tape: Tape,
    ):
        """A world cut off while it held something lets go: nothing is held between launches."""
        if wp.static(with_sheets):
            if ends:
                for i in range(at.p0, at.p0 + at.particles):
                    cells.xr[i] = cells.xr[i] + run.drift
        if wp.static(taped):
            mark = int(tops[2])
        for lane in range(wp.static(L)):
            if ends and run.holding[lane] > S(0.0):
                world = at.world0 + lane
                if wp.static(taped):
                    tape.k[tops[2]] = lane
                    tape.k[tops[2] + 1] = grips.particle[world]
                    if grips.particle[world] < 0:
                        tape.k[tops[2] + 1] = -1 - grips.body[world]
                    tops[2] += 2
                let_go(world, lane, at.p0, at.b0 + lane * at.bodies, particles, bodies, grips)
        if wp.static(taped):
            tape.k[tops[2]] = (tops[2] - mark) // 2
            tops[2] += 1
            tape.top[at.g] = tops

    return SimpleNamespace(begin=begin, record_frame=record_frame, end=end)
