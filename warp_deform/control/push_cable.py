"""push-cable: push a cable into a shape with a box.

Definition (ours). A cable of 24 beads, 0.325 m, lies straight on the table. A box of 3 x 3 x 8 cm
that the tip holds, and keeps, is led for 120 steps of 50 ms, at up to 1 m/s: long enough for six
pushes. The goal is the outcome of six random pushes, which the seed draws. What counts is the cable
at the end. Solved: a score of 0.85, for a cable that nobody has touched has 0.6 to 0.7.

Source: Push-Rope (`shape_rope`) of DaXBench (Chen et al., ICLR 2023), whose score, exp(-10 D) with
D the mean over particles of the root mean square of their distance along x, y, z, is taken as it
is.

Differences. DaXBench simulates a rope of 0.25 m by the material point method, which two random
pushes have bent before; its goal is one shape made by hand; its six actions are whole straight
pushes, at most 0.3 m, and its box is put where each begins. Here the box goes there itself. Numbers
of theirs and of ours never belong into one row of a table without that sentence.

Number to beat: a score of 0.75 (DaXBench's PPO and SHAC). The start has a score, too: see the table
of the page.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box, BoxConfig, BoxPart, add_box
from ..objects.cable import Cable, add_cable, cable_line
from ..objects.colors import GRAY
from ..tasks.free_space import FreeSpace
from ..tasks.task import Layout, Snapshot, Stage
from .cable_goal import CableGoalTask
from .held_cable import CABLE
from .modes import ControlConfig

if TYPE_CHECKING:
    import newton

__all__ = ["PushCable", "push_actions"]

_BOX = (0.03, 0.03, 0.08)
_START = (0.5, -0.16)
"""Where the first bead lies on average before the first push [m]."""
_SHIFT = 0.02
"""Spread of the start along x and y [m]."""
_ASIDE = 0.12
"""How far beside the middle of the cable the box waits [m]."""
_REACH = 0.08
"""A random push begins so far before a bead and ends so far behind it [m]."""
_ABOVE = 0.05
"""Height by which the box is lifted between pushes [m]."""
_ACROSS = 8
"""Control steps in which the box goes across to a push, and along it."""
_AT_ONCE = 0.9
"""Share of the greatest speed at which it goes at most."""


class PushCable(CableGoalTask):
    """Every bead as after other pushes."""

    name = "push-cable"
    instruction = "Push the cable into the shape of the goal with the box."
    stages = (Stage(lift=0.04, speed=0.15),)
    solver = CABLE
    success_score = 0.85
    ground_truth_size = 3 * 49
    objects = ("cable", "box")
    horizon = 120
    held_body = 0
    keeps_hold = True

    pushes: ClassVar[int] = 6

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable | Box, ...]:
        """Add the cable, straight along y, and the box."""
        cable = add_cable(builder, self.cable, cable_line(self.cable, _START, (_START[0], 1.0)))
        config = BoxConfig(parts=(BoxPart(_BOX),), mass=0.2, color=GRAY)
        return cable, add_box(builder, config, (_START[0] - _ASIDE, 0.0, _BOX[2] / 2))

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The straight cable, the box beside it; its goal comes from `plan_for`."""
        x, y = rng.normal(_START, _SHIFT)
        beads = cable_line(self.cable, (x, y), (x, y + 1.0))
        place = [x - _ASIDE, y + 0.16, _BOX[2] / 2, 0.0, 0.0, 0.0, 1.0]
        return Layout(particle_q=beads, body_q=np.array([place]), targets=beads)

    def plan_for(self, layout: Layout, rng: np.random.Generator) -> np.ndarray:
        """Pushes of 16 cm, each through where a bead lies at first, in any direction."""
        through = layout.particle_q[rng.integers(self.cable.beads, size=self.pushes), :2]
        angle = rng.uniform(-np.pi, np.pi, self.pushes)
        way = _REACH * np.column_stack([np.cos(angle), np.sin(angle)])
        ends = np.stack([through - way, through + way], axis=1)
        return push_actions(layout.body_q[0, :2], ends, self.control)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(147,): x, y, z of every bead, then of every bead of the goal, then of the box."""
        points = [snapshot.particle_q, layout.targets, snapshot.body_q[:, :3]]
        return np.concatenate(points).astype(np.float32).ravel()


def push_actions(place: np.ndarray, pushes: np.ndarray, control: ControlConfig) -> np.ndarray:
    """Actions (20 N, 3) of a box that stands at `place` (2,) [m] and makes N straight pushes.

    A push takes 20 steps: 2 up, 8 across, 2 down, and 8 along it. What is too far for them is not
    reached.

    Args:
        pushes: where each begins and ends (N, 2, 2) [m]
    """
    step = control.max_speed * control.seconds
    rise = np.array([[0.0, 0.0, _ABOVE / 2]] * 2)
    at, moves = np.array(place, dtype=float), []
    for begin, end in pushes:
        for goal, before in ((begin, rise), (end, -rise)):
            way = np.append(goal - at, 0.0)
            way *= min(1.0, _ACROSS * step * _AT_ONCE / max(float(np.linalg.norm(way)), 1e-9))
            at = at + way[:2]
            moves += [*before, *([way / _ACROSS] * _ACROSS)]
    return np.array(moves) / step
