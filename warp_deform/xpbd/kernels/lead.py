"""What is gripped follows the tip for a substep, and is let go where its path ends."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import any_less, sub  # noqa: F401  (operators are found by name)
from ..lanes.group_state import group_state
from ..lanes.tape import GRIP_WORDS
from .grip import grip
from .grip_adjoint import grip_adjoint

__all__ = ["leads"]


@functools.cache
def leads(
    scalar: Any, lanes: int, with_bodies: bool, with_sheets: bool, taped: bool
) -> SimpleNamespace:
    """`lead_grips` moves all that a group holds and returns its `Run` and the tops of the tape."""
    t = group_state(scalar, lanes)
    S, V, L = t.S, t.V, t.L
    Span, Pace, Run = t.Span, t.Pace, t.Run
    Topology, Group, Particles, Pairs, Shapes = t.Topology, t.Group, t.Particles, t.Pairs, t.Shapes
    Near, Bodies, Grips, Cells, Tape = t.Near, t.Bodies, t.Grips, t.Cells, t.Tape
    follow_path, let_go = grip(scalar, lanes).follow_path, grip(scalar, lanes).let_go
    record_grip = grip_adjoint(scalar, lanes, with_bodies).record_grip

    @wp.func
    def lead_grips(
        at: Span,
        pace: Pace,
        run: Run,
        tops: wp.vec4i,
        top: Topology,
        group: Group,
        particles: Particles,
        pairs: Pairs,
        shapes: Shapes,
        near: Near,
        bodies: Bodies,
        grips: Grips,
        cells: Cells,
        tape: Tape,
    ):
        zero = V(S(0.0))
        if wp.static(taped):
            mark = int(tops[2])
        if any_less(zero - run.holding, S(0.0)):
            holding = run.holding
            calm = run.calm
            least = run.least
            for lane in range(wp.static(L)):
                if holding[lane] > S(0.0) and run.on[lane] > S(0.0):
                    world = at.world0 + lane
                    met = bool(False)
                    if wp.static(with_sheets):
                        met = cells.met[world] > 0
                    if wp.static(taped):
                        tick = grips.tick[world]
                        knot = grips.knot[world]
                        shift = grips.shift[world]
                    goes_on = follow_path(
                        lane,
                        met,
                        at,
                        run.near_count,
                        pace.dt,
                        top,
                        particles,
                        pairs,
                        shapes,
                        near,
                        bodies,
                        grips,
                    )
                    if wp.static(taped):
                        released = wp.where(goes_on, 0, 1)
                        record_grip(tops[2], world, lane, tick, knot, shift, released, grips, tape)
                        tops[2] += wp.static(GRIP_WORDS)
                    if not goes_on:
                        let_go(
                            world, lane, at.p0, at.b0 + lane * at.bodies, particles, bodies, grips
                        )
                        holding[lane] = S(0.0)
                        after = group.calm_after[at.g]
                        calm[lane] = after[lane]
                        least[lane] = least[lane] + run.steps[lane]
            run.holding = holding
            run.calm = calm
            run.least = least
        if wp.static(taped):
            tape.k[tops[2]] = (tops[2] - mark) // wp.static(GRIP_WORDS)
            tops[2] += 1
        return run, tops

    return SimpleNamespace(lead_grips=lead_grips)
