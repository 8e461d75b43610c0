"""Gradients of whole actions by their place, compared with differences over a millimetre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..planning.gradients import LANES, gradients_for
from ..planning.places import MOST_GROWTH
from ..tasks.task import Task
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds
from .draws import actions_of_episodes

__all__ = ["STEP", "ActionSample", "compare_actions"]

STEP = 1e-3
"""Of the finite differences of a place point [m]."""
REST = 1.0
"""Longest wait for rest after an action of the differences [s], as where searches try actions."""
_PRECISION = "float32"


@dataclass(frozen=True, eq=False)
class ActionSample:
    """Of one action: growth of its gradient, whether a search would use it, and the cosines of its
    derivative by place x, y with differences of the rollout that was differentiated (which may be
    damped, see `Task.gradient_damping`) and of the one that counts; None where neither moves.
    """

    growth: float
    usable: bool
    cosine_same: float | None
    cosine_real: float | None


def compare_actions(task: Task, count: int, *, seed: int) -> list[ActionSample]:
    """The first `count` actions of episodes from `seed` on.

    Raises:
        InputError: the task has no derivatives of actions.
    """
    gradients = gradients_for(task, "ur5", _PRECISION)
    worlds = Worlds(task, LANES, lanes=LANES, precision=_PRECISION, rest_limit=REST)
    samples: list[ActionSample] = []
    for start in actions_of_episodes(worlds, seed) if count else ():
        moved = [start.action]
        for at in (3, 4):
            for sign in (1, -1):
                moved.append(start.action.copy())
                moved[-1][at] += sign * STEP
        ours, *same = gradients.of([(start.before, action) for action in moved])
        before = worlds.state(0)
        real = _losses(worlds, start.before, moved[1:])
        worlds.restore(0, before)
        by_place = ours.by_place[:2]
        samples.append(
            ActionSample(
                growth=ours.growth,
                usable=ours.usable and ours.growth <= MOST_GROWTH,
                cosine_same=_cosine(by_place, [gradient.loss for gradient in same]),
                cosine_real=_cosine(by_place, real),
            )
        )
        if len(samples) == count:
            break
    return samples


def _losses(worlds: Worlds, before: WorldState, actions: list[np.ndarray]) -> list[float]:
    """The task's loss after each action as it really runs."""
    import torch

    for slot in range(len(actions)):
        worlds.restore(slot, before)
    worlds.step(dict(enumerate(actions)))
    episode, losses = before.episode, []
    for slot in range(len(actions)):
        after = worlds.episodes[slot].snapshot
        ends = [
            torch.tensor(array, dtype=torch.float64) for array in (after.particle_q, after.body_q)
        ]
        losses.append(float(worlds.task.loss(episode.layout, episode.snapshot, *ends)))
    return losses


def _cosine(by_place: np.ndarray, losses: list[float]) -> float | None:
    """With the gradient by central differences of x+, x-, y+, y-."""
    plus_x, minus_x, plus_y, minus_y = losses
    change = np.array([plus_x - minus_x, plus_y - minus_y])
    lengths = np.linalg.norm(change) * np.linalg.norm(by_place)
    if not np.isfinite(lengths) or lengths == 0:
        return None
    return float(change @ by_place / lengths)
