"""What a task says about its control at a fixed rate, beyond what every `Task` says."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..tasks.task import Action, Layout, Snapshot, Task
from .modes import ControlConfig

__all__ = ["ControlTask", "horizon_of"]

_SECONDS = 10.0
"""Length of an episode of a task that says nothing else [s]."""


class ControlTask(Task):
    """A task that is made for control: it says how long it lasts, what is held, and how fast.

    Tasks of the benchmark need none of this: they have the defaults.
    """

    control: ClassVar[ControlConfig] = ControlConfig()
    """Rate and speeds."""
    horizon: ClassVar[int]
    """Control steps of an episode."""
    ends_when_solved: ClassVar[bool] = False
    """Whether an episode ends when it is solved, or only when its steps are used up."""
    held_particle: ClassVar[int | None] = None
    """What the tip holds from the start, by any `start`; None: as `start` says."""
    held_body: ClassVar[int | None] = None
    """The same where it is a body; at most one of the two is given."""
    keeps_hold: ClassVar[bool] = False
    """Whether the tip never lets go of it, whatever an action says of `hold`."""

    first_actions: ClassVar[int] = 0
    """Picks and places that have made the start, see `first_action`."""

    @property
    def solved_first(self) -> bool:
        """Whether searches take any plan that solves for better than all that do not.

        Where a low loss is not yet success.
        """
        return False

    def first_action(self, snapshot: Snapshot, rng: np.random.Generator) -> Action:
        """One of the picks and places that make the start."""
        raise TypeError(f"{self.name} starts as it was laid out")

    def starts_like(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether an episode may start as these have left it; others are drawn again, counted."""
        return not self.solved(layout, snapshot)

    def plan_to_goal(self, rng: np.random.Generator) -> np.ndarray | None:
        """Actions (T, 3), each of a length below 1, whose outcome is the goal; None: the layout's.

        A plan that a guard ends, or whose outcome is no goal (`is_goal`), is drawn again.
        """
        return None

    def plan_for(self, layout: Layout, rng: np.random.Generator) -> np.ndarray | None:
        """Actions (T, 3) of a plan for an episode that starts like `layout`; see `plan_to_goal`."""
        return self.plan_to_goal(rng)

    def is_goal(self, particle_q: np.ndarray) -> bool:
        """Whether the state that a plan has led to, particles (P, 3) [m], is a goal to pursue."""
        return True

    def layout_for(self, layout: Layout, particle_q: np.ndarray) -> Layout:
        """The layout whose goal is the state that a plan has led to, particles (P, 3) [m]."""
        raise TypeError(f"{self.name} has no goal that a plan leads to")

    def marks(self, layout: Layout) -> np.ndarray:
        """Points of the goal (n, 3) [m] that a film shows where no zone tells it."""
        return np.zeros((0, 3))


def horizon_of(task: Task, config: ControlConfig) -> int:
    """Control steps of an episode of `task`."""
    if isinstance(task, ControlTask):
        return task.horizon
    return round(_SECONDS * config.rate)
