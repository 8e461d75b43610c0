"""Episodes that an actor plays, and what they amount to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError

from ..evaluation.summary import wilson

__all__ = ["PlayedControl", "bootstrapped", "play_control"]

_DRAWS = 2000
"""Of a bootstrap."""


@dataclass(frozen=True, eq=False)
class PlayedControl:
    """The ends of episodes, in the order of their seeds.

    Attributes:
        left: what was left to do (N,), see `Task.remaining`; inf where a guard has fired
        scores: of the task (N,); 0 where a guard has fired
        solved: (N,) bool
    """

    left: np.ndarray
    scores: np.ndarray
    solved: np.ndarray

    def summary(self) -> dict[str, Any]:
        """Numbers in JSON's types.

        n_episodes, n_success, pc_success [%], pc_success_ci95: Wilson's interval [%], n_guards:
        episodes that a guard has ended, unsolved; mean_score with mean_score_ci95, bootstrapped;
        mean_left: of the others, None where there are none
        """
        count, solved = len(self.left), int(self.solved.sum())
        fine = self.left[np.isfinite(self.left)]
        return {
            "n_episodes": count,
            "n_success": solved,
            "pc_success": 100 * solved / count,
            "pc_success_ci95": list(wilson(solved, count)),
            "n_guards": count - len(fine),
            "mean_score": float(self.scores.mean()),
            "mean_score_ci95": list(bootstrapped(self.scores)),
            "mean_left": float(fine.mean()) if len(fine) else None,
        }


@torch.no_grad()
def play_control(
    worlds: TensorControlWorlds,
    act: Callable[[Tensor], Tensor],
    seeds: Sequence[int],
    *,
    advance: Callable[[int], object] | None = None,
) -> PlayedControl:
    """Play the episodes of seeds, as many at once as there are worlds.

    Args:
        act: observations (W, D) in, actions (W, 4) out
        advance: is told how many more have been played

    Raises:
        InputError: there are no seeds.
    """
    if not len(seeds):
        raise InputError("there is nothing to play: give one seed or more")
    count, left, scores, solved = worlds.worlds.count, [], [], []
    for first in range(0, len(seeds), count):
        some = [int(seed) for seed in seeds[first : first + count]]
        filled = some + some[:1] * (count - len(some))
        worlds.reset(dict(enumerate(filled)))
        while worlds.running.any():
            worlds.advance(act(worlds.observe()))
        trusted = worlds.trusted
        left.append(np.where(trusted, worlds.left.numpy(), np.inf)[: len(some)])
        for slot in range(len(some)):
            scores.append(worlds.worlds.score(slot))
            solved.append(bool(trusted[slot]) and bool(worlds.worlds.solved(slot)))
        if advance is not None:
            advance(len(some))
    return PlayedControl(np.concatenate(left), np.array(scores), np.array(solved))


def bootstrapped(values: np.ndarray) -> tuple[float, float]:
    """A 95 % interval of the mean of values (N,), by draws with replacement.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), section 13.3.
    """
    rng = np.random.default_rng(0)
    means = rng.choice(values, (_DRAWS, len(values))).mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)
