"""`Places`: the four numbers of a place that a search moves, their limits, and random draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..robots.primitive import LIFT
from ..tasks.task import Action, Task
from .gradients import PLACE, PlaceGradient

__all__ = ["MOST_GROWTH", "Places"]

MOST_GROWTH = 1e5
"""A gradient whose rollout is more chaotic than that is not used."""
_INSIDE = 1e-3
"""A moved lift stays so far from that at which the next stage begins [m]."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """Draws and limits of place x, y [m], yaw [rad] and lift [m].

    Attributes:
        spread: standard deviation of drawn places [m]
        turn_spread: that of drawn yaws [rad]
        lift_spread: that of drawn lifts [m]
        lifts: whether the lift moves; else it is the action's
    """

    task: Task
    spread: float
    turn_spread: float
    lift_spread: float
    lifts: bool

    def drawn(self, action: Action, rng: np.random.Generator, scale: float = 1.0) -> Action:
        """The same pick, placed near by, in view."""
        near = action.copy()
        near[3:5] += rng.normal(0.0, self.spread * scale, 2)
        if near[5] != 0.0:
            near[5] += rng.normal(0.0, self.turn_spread * scale)
        if self.lifts:
            near[6] += rng.normal(0.0, self.lift_spread * scale)
        return self.limited(near, action)

    def limited(self, action: Action, like: Action) -> Action:
        """`action` with its place in view and its lift within the stage of `like`.

        Where the picture ends, a policy could not be taught to place.
        """
        inside = action.copy()
        inside[3:5] = self.task.grid.in_view(inside[3:5])
        if self.lifts:
            inside[6] = np.clip(inside[6], *self._lifts(float(like[6])))
        return inside

    def gradient(self, gradient: PlaceGradient, action: Action) -> np.ndarray | None:
        """The gradient (4,) by what may move of an action; None: not to be used."""
        if not gradient.usable or gradient.growth > MOST_GROWTH:
            return None
        by_place = gradient.by_place.copy()
        if action[5] == 0.0:
            by_place[2] = 0.0  # a task that places without a turn has no use for one
        if not self.lifts:
            by_place[3] = 0.0
        return by_place

    def moved(self, action: Action, change: np.ndarray, like: Action) -> Action:
        """`action` with its place (4,) changed."""
        moved = action.copy()
        moved[PLACE] += change
        return self.limited(moved, like)

    def _lifts(self, lift: float) -> tuple[float, float]:
        """Least and greatest lift of the stage that `lift` belongs to [m]."""
        own = self.task.stage_of(lift).lift
        middles = [(own + s.lift) / 2 for s in self.task.stages if s.lift != own]
        low = max([LIFT[0], *(m + _INSIDE for m in middles if m < own)])
        high = min([LIFT[1], *(m - _INSIDE for m in middles if m > own)])
        return low, high
