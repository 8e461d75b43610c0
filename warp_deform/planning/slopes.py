"""How what is left to do changes with where an action places, by the solver's adjoint.

A heap of beads is chaotic: the exact derivative of where it ends is large and points nowhere. Where
a task says so (`Task.slope_damping`), the rollout that is differentiated is damped more than the
one that counts, and its derivative agrees with what 5 mm do to the latter.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..differentiable import DifferentiableRollout
from ..running import Carry, RunningEpisode
from ..tasks.task import Action, Task
from ..world_state import WorldState
from ..worlds import Worlds

__all__ = ["Slope", "Slopes", "slopes_for"]

LANES = 8
PLACE = slice(3, 6)
"""The part of an action that slopes are taken by: place x, y [m], yaw [rad]."""
SETTLE = 0.3
"""How long a world runs on after the longest path, before the loss is taken [s]."""
_MEMORY = 2**29  # bytes
_STEP = 1e-5  # of the finite differences of a path by its action, which is smooth [m], [rad]


@dataclass(frozen=True, eq=False)
class Slope:
    """Loss of the task after an action, and its derivatives by place x, y [1/m], yaw [1/rad].

    usable: whether the tip took something and every derivative is a number
    growth: largest derivative by a position at the start over the largest by one at the end; large
    where the rollout is chaotic
    """

    loss: float
    by_place: np.ndarray
    growth: float
    usable: bool


_NONE = Slope(np.inf, np.zeros(3), np.inf, False)


class Slopes:
    """Worlds in which actions are differentiated, `LANES` at a time; `rollouts` counts them."""

    def __init__(self, task: Task, *, robot: str, precision: str) -> None:
        self._worlds = Worlds(task, LANES, robot=robot, lanes=LANES, precision=precision)
        # what sleeps does not answer to a small change
        self._run = DifferentiableRollout(self._worlds.solver, memory=_MEMORY, sleep=False)
        if task.slope_damping is not None:
            for slot in range(LANES):
                self._worlds.solver.set_world(slot, damping=task.slope_damping)
        self.rollouts = 0

    def of(self, jobs: Sequence[tuple[WorldState, Action]]) -> list[Slope]:
        """The slope of every action from its state, in the order given."""
        slopes: list[Slope] = []
        for first in range(0, len(jobs), LANES):
            slopes += self._of_lanes(jobs[first : first + LANES])
        self.rollouts += len(jobs)
        return slopes

    def _of_lanes(self, jobs: Sequence[tuple[WorldState, Action]]) -> list[Slope]:
        worlds = self._worlds
        before = [state.episode for state, _ in jobs]
        for slot, (state, _) in enumerate(jobs):
            worlds.restore(slot, state)
        carries = worlds.lead({slot: action for slot, (_, action) in enumerate(jobs)})
        slopes = [_NONE] * len(jobs)
        slots = sorted(carries)
        if not slots:
            return slopes
        paths = {slot: carries[slot](jobs[slot][1])[1] for slot in slots}
        end = max(float(path.times[-1]) for path in paths.values()) + SETTLE
        ends = self._run.forward(slots, [end], paths=paths)[:, 0]
        losses, by_ends = zip(
            *(_loss(worlds.task, before[slot], x) for slot, x in zip(slots, ends, strict=True)),
            strict=True,
        )
        gradients = self._run.backward(np.stack(by_ends)[:, None])
        for k, slot in enumerate(slots):
            by_place = _by_place(
                carries[slot], jobs[slot][1], gradients.way_points[slot], gradients.knot_times[slot]
            )
            most = np.abs(by_ends[k]).max()
            growth = float(np.abs(gradients.positions[k]).max() / most) if most > 0 else np.inf
            usable = bool(np.isfinite(by_place).all() and np.isfinite(losses[k]))
            slopes[slot] = Slope(losses[k], by_place, growth, usable)
        return slopes


def _loss(task: Task, episode: RunningEpisode, particle_q: np.ndarray) -> tuple[float, np.ndarray]:
    """The task's loss of an end state, and its derivative (P, 3)."""
    import torch

    x = torch.tensor(particle_q, dtype=torch.float64, requires_grad=True)
    bodies = torch.tensor(episode.snapshot.body_q, dtype=torch.float64)
    value = task.loss(episode.layout, episode.snapshot, x, bodies)
    (slope,) = torch.autograd.grad(value, x)
    return value.item(), slope.numpy()


def _by_place(
    carried: Carry, action: Action, by_points: np.ndarray, by_times: np.ndarray
) -> np.ndarray:
    """Chain derivatives by the knots of a path (K, 3), (K,) back to the place pose (3,)."""
    out = np.zeros(3)
    for i, at in enumerate(range(PLACE.start, PLACE.stop)):
        ends = []
        for sign in (1, -1):
            moved = action.copy()
            moved[at] += sign * _STEP
            ends.append(carried(moved)[1])
        if not len(ends[0].times) == len(ends[1].times) == len(by_times):
            return np.full(3, np.nan)  # the path is about to get another knot
        by_position = (ends[0].positions - ends[1].positions) / (2 * _STEP)
        by_time = (ends[0].times - ends[1].times) / (2 * _STEP)
        out[i] = (by_points * by_position).sum() + (by_times * by_time).sum()
    return out


@functools.lru_cache(maxsize=2)
def slopes_for(task: Task, robot: str, precision: str) -> Slopes:
    """This process's worlds to differentiate actions in, built once and used again.

    Raises:
        InputError: the task has rigid bodies, which derivatives do not reach.
    """
    return Slopes(task, robot=robot, precision=precision)
