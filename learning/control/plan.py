"""Plan: a network that plans a whole swing at once. One file, read from top to bottom.

    once: what W x many episodes look like when they begin
    for every update
        draw W of them, and let the network plan their T moves
        each plan's loss has a gradient by its T x 3 numbers: keep its direction
        let the network, at what it saw, plan a little more against that direction

A plan is one launch of the simulator, forth and back, so an update costs a fifth of one that plays
control steps. Its gradient is exact, and chaotic: 10,000 times as long in one episode as in
another. So each episode counts by the direction, and by what is still to do. The policy acts open
loop: it sees where an episode begins, and nothing of what comes of its plan.

Source: amortised optimisation, as in Amos, "Tutorial on Amortized Optimization", 2023, section 2.2;
directions in place of gradients as in `warp_deform.control.plan_descent`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.control.control_task import ControlTask
from warp_deform.control.swing_problem import SwingProblem
from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError
from warp_deform.support.checked import POSITIVE, check_fields

from .actor import PlanActor
from .checkpoint import put_back, tensors_of

__all__ = ["PlanConfig", "PlanLearner"]

_STREAM = 19
"""Keeps the generator of this training apart from those of episodes."""


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How to train a network that plans.

    Attributes:
        lr: Adam's step size at first; it falls linearly to 0
        gradient_norm: longest gradient by all weights
        near: a plan that leaves less than this share of what idleness leaves counts less, by the
            square root, and nothing where nothing is left

    Raises:
        InputError: a number is not positive.
    """

    lr: float = 5e-4
    gradient_norm: float = 1.0
    near: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, dict.fromkeys(vars(self), POSITIVE))


class PlanLearner:
    """A network in training. The same seed gives the same bits on one thread of torch.

    Whatever is random in an update is drawn from (seed, update), so an interrupted training goes on
    as it would have, from `tensors`.

    Args:
        worlds: whose task it is; they show how episodes begin
        episodes: seeds from 0 on among which an update draws
        updates: after which the step size is 0

    Raises:
        InputError: the task is no swing, or is cut short, or the number of worlds is no multiple
            of 8.
    """

    def __init__(
        self,
        worlds: TensorControlWorlds,
        config: PlanConfig,
        *,
        episodes: int,
        updates: int,
        seed: int,
    ) -> None:
        task, self.count = worlds.task, worlds.worlds.count
        if not isinstance(task, ControlTask) or task.held_particle is None:
            raise InputError(
                f"the method plan is for swings, which hold something from the start; {task.name} "
                "is none: take apg or shac"
            )
        if worlds.horizon != task.horizon:
            raise InputError(
                f"a plan of {task.name} is {task.horizon} steps long, not {worlds.horizon}: leave "
                "--horizon out"
            )
        self.config, self.seed, self.episodes, self.updates = config, seed, episodes, updates
        self._problem = _problem(task.name, episodes, self.count)
        self._first = _first(worlds, episodes)
        idle = np.zeros((episodes, 1, *self._problem.shape))
        left = self._problem.evaluate(idle)
        self._near = config.near * float(left[np.isfinite(left)].mean())
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = PlanActor(self._first.shape[1], steps=task.horizon)
        self.actor.norm.update(self._first)
        self.optimizer = torch.optim.Adam(self.actor.network.parameters(), lr=config.lr)

    def tensors(self) -> dict[str, Tensor]:
        """All that the next update goes on from, by name."""
        return tensors_of({"actor": self.actor}, {"actor": self.optimizer})

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave.

        Raises:
            InputError: names or shapes are others.
        """
        put_back(tensors, {"actor": self.actor}, {"actor": self.optimizer})

    def update(self, number: int) -> dict[str, float]:
        """One update of the weights, counted from 1; what it came to."""
        # Episodes of this update, and what the network plans for them
        rng = np.random.default_rng([_STREAM, self.seed, number])
        goals = np.sort(rng.choice(self.episodes, self.count, replace=False))
        plans = self.actor.plans(self._first[goals])

        # Which way each plan is better; one that a guard has ended says nothing
        losses, gradients = self._problem.gradients(plans.detach().double().numpy(), goals)
        fired = np.isinf(losses)
        finite = np.isfinite(gradients).all(axis=(1, 2))
        gradients[~finite] = 0.0
        lengths = np.linalg.norm(gradients, axis=(1, 2), keepdims=True)
        left = np.where(fired, 0.0, losses)
        weights = np.sqrt(np.minimum(left / self._near, 1.0))[:, None, None]
        ways = weights * gradients / np.maximum(lengths, 1e-300)

        # The network plans a little more like that
        self.optimizer.param_groups[0]["lr"] = self.config.lr * (1.0 - (number - 1) / self.updates)
        self.optimizer.zero_grad()
        plans.backward(torch.from_numpy(ways / self.count).float())
        weights_of = self.actor.network.parameters()
        norm = nn.utils.clip_grad_norm_(weights_of, self.config.gradient_norm)
        self.optimizer.step()
        return {
            "loss": float(left.sum() / max(1, (~fired).sum())),
            "gradient": float(norm),
            "unusable": float((~finite & ~fired).sum()),
            "guards": float(fired.sum()),
        }


@functools.lru_cache(maxsize=1)
def _problem(task: str, episodes: int, worlds: int) -> SwingProblem:
    """Kept, since a run is planned by a learner of its own."""
    return SwingProblem(task, range(episodes), worlds=worlds)


def _first(worlds: TensorControlWorlds, episodes: int) -> Tensor:
    """What episodes look like when they begin (E, D)."""
    count, shown = worlds.worlds.count, []
    for first in range(0, episodes, count):
        worlds.reset({slot: (first + slot) % episodes for slot in range(count)})
        shown.append(worlds.observe())
    return torch.cat(shown)[:episodes]
