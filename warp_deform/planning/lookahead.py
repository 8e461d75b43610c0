"""Try actions from saved states, many side by side, and rank what becomes of them."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import WarpDeformError
from ..robots.primitive import Outcome
from ..tasks.task import Action, Task
from ..worlds.spaces import action_space
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds
from .gradients import LANES, ActionGradients, gradients_for

LOOKAHEAD_REST = 1.0
"""Longest wait for rest after a tried action [s]; what still moves is judged as it is."""


@dataclass(frozen=True, eq=False)
class Outlook:
    """What an action leads to.

    Attributes:
        grade: 4 solved, 3 solved but an item is not enclosed (`Task.enclosed`), 2 placed, 1 nothing
            moved, 0 not to be trusted or the episode over without success
        state_value: of the task for the state that the action leaves; greater is better
    """

    action: Action
    grade: int
    state_value: float
    score: float
    after: WorldState | None
    """The state that the action leaves, where it was asked for."""
    origin: str = "candidate"
    """Where the action comes from: a task's candidate, "drawn" near by, or by "gradient"."""

    @property
    def rank(self) -> tuple[int, float]:
        """Orders outlooks; the greater the better."""
        return self.grade, self.state_value

    @property
    def done(self) -> bool:
        """Whether nothing is left to wish for: solved, with every item enclosed where there are."""
        return self.grade == 4

    @property
    def goes_on(self) -> bool:
        """Whether something moved, and the episode is not over then."""
        return self.grade == 2

    @property
    def ends_badly(self) -> bool:
        """Whether it ends the episode without success, or with an item that is not enclosed."""
        return self.grade in (0, 3)

    @property
    def solved(self) -> bool:
        """Whether the task is done then."""
        return self.grade >= 3


class Lookahead:
    """Worlds in which actions are tried; `rollouts` counts them."""

    def __init__(self, task: Task, *, robot: str, precision: str, count: int) -> None:
        self._worlds = Worlds(
            task, count, robot=robot, lanes=LANES, precision=precision, rest_limit=LOOKAHEAD_REST
        )
        self._gradients = functools.partial(gradients_for, task, robot, precision)
        self.rollouts = 0

    def gradients(self) -> ActionGradients:
        """The worlds in which the same actions are differentiated.

        Raises:
            InputError: the task has none.
        """
        return self._gradients()

    def try_each(
        self, jobs: Sequence[tuple[WorldState, Action]], *, keep: bool = False
    ) -> list[Outlook]:
        """The outlook of every action from its state, in the order given.

        An outlook depends on its state and action alone. An action that the environments do not
        allow moves nothing.

        Args:
            keep: whether outlooks hold the state afterwards
        """
        outlooks: dict[int, Outlook] = {}
        space = action_space()
        allowed = [i for i, (_, action) in enumerate(jobs) if space.contains(action)]
        for i in set(range(len(jobs))).difference(allowed):
            outlooks[i] = Outlook(jobs[i][1], 0, -math.inf, 0.0, None)
        # lanes wait for the slowest among them, so those that carry equally far go together
        order = sorted(allowed, key=lambda i: _distance(jobs[i][1]))
        for first in range(0, len(order), self._worlds.count):
            part = dict(enumerate(order[first : first + self._worlds.count]))
            for slot, i in part.items():
                self._worlds.restore(slot, jobs[i][0])
            reports = self._worlds.step({slot: jobs[i][1] for slot, i in part.items()})
            for slot, i in part.items():
                outlooks[i] = self._outlook(slot, jobs[i][1], reports[slot].outcome, keep)
        self.rollouts += len(order)
        return [outlooks[i] for i in range(len(jobs))]

    def _outlook(self, slot: int, action: Action, outcome: Outcome, keep: bool) -> Outlook:
        worlds = self._worlds
        if outcome is Outcome.INVALID:
            return Outlook(action, 0, -math.inf, 0.0, None)
        episode = worlds.episodes[slot]
        state_value = float(worlds.task.state_value(episode.layout, episode.snapshot))
        if not math.isfinite(state_value):
            raise WarpDeformError(f"{worlds.task.name}: the value of a state is {state_value}")
        if outcome is not Outcome.PLACED:
            grade = 1
        elif worlds.solved(slot):
            grade = 3 if worlds.enclosed(slot) is False else 4
        else:
            grade = 0 if episode.ended else 2
        after = worlds.state(slot) if keep else None
        return Outlook(action, grade, state_value, worlds.score(slot), after)


@functools.lru_cache(maxsize=2)
def lookahead_for(task: Task, robot: str, precision: str, count: int) -> Lookahead:
    """This process's worlds to try actions in, built once and used again."""
    return Lookahead(task, robot=robot, precision=precision, count=count)


def _distance(action: Action) -> float:
    """How far an action carries [m]."""
    return float(np.linalg.norm(action[3:5] - action[:2]))
