"""What an agent is paid: change of the score, progress of the task's loss, or success alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from ..errors import InputError
from .worlds import Worlds

__all__ = ["RewardMode", "Rewards"]

RewardMode = Literal["score", "dense", "normalized_dense", "sparse", "none"]
_LEAST_START = 1e-6
"""A start with less left to do than this counts as having so much: nothing is divided by nought."""


class Rewards:
    """Counts the rewards of the episodes in `worlds`: `start` at a reset, `take` after a step.

    - "score": change of the score;
    - "dense": (r_before - r_after) / r_start, with r what `Task.remaining` says is left to do; an
      episode's rewards sum to its progress, 1 where everything is done;
    - "normalized_dense": exp(-r_after / r_start), in (0, 1]: 0.37 at the start, 1 when done;
    - "sparse": 1 in a solved state, else 0;
    - "none": 0.

    The goal is the layout's, which an episode keeps. A state that a guard has found wrong pays 0.

    Raises:
        InputError: there is no such mode, or the mode needs a loss that the task does not define.
    """

    def __init__(self, worlds: Worlds, mode: str) -> None:
        if mode not in get_args(RewardMode):
            known = ", ".join(get_args(RewardMode))
            raise InputError(f"reward_mode is one of {known}, not {mode!r}")
        task = type(worlds.task)
        if mode in ("dense", "normalized_dense") and not task.has_loss():
            raise InputError(f"{task.name} has no loss; reward_mode can be score, sparse or none")
        self._worlds, self.mode = worlds, mode
        self._start, self._before = np.ones((2, worlds.count))

    def start(self, slots: Sequence[int]) -> None:
        """Note from where the episodes that have just begun in these slots set out."""
        self._before[list(slots)] = self._values(slots)
        if self.mode in ("dense", "normalized_dense"):
            self._start[list(slots)] = np.maximum(self._before[list(slots)], _LEAST_START)

    def take(self, slots: Sequence[int]) -> np.ndarray:
        """Rewards (n,) of the steps that these slots have just made."""
        at = list(slots)
        after, before, start = self._values(at), self._before[at], self._start[at]
        self._before[at] = after
        if self.mode == "score":
            rewards = after - before
        elif self.mode == "dense":
            rewards = (before - after) / start
        elif self.mode == "normalized_dense":
            rewards = np.exp(-np.maximum(after, 0.0) / start)
        else:
            rewards = after
        trusted = np.array([self._worlds.episodes[slot].physics_ok for slot in at], dtype=bool)
        # the score of a state that is not to be trusted is 0, so its change is told as it is
        return rewards if self.mode == "score" else np.where(trusted, rewards, 0.0)

    def _values(self, slots: Sequence[int]) -> np.ndarray:
        """What the mode looks at, of every slot (n,)."""
        if self.mode == "score":
            return np.array([self._worlds.score(slot) for slot in slots], dtype=float)
        if self.mode == "sparse":
            return np.array([self._worlds.solved(slot) for slot in slots], dtype=float)
        if self.mode == "none" or not len(slots):
            return np.zeros(len(slots))
        return self._remaining(slots)

    def _remaining(self, slots: Sequence[int]) -> np.ndarray:
        """What is left to do (n,); of states that are not to be trusted as much as before."""
        import torch

        episodes = [self._worlds.episodes[slot] for slot in slots]
        trusted = np.array([episode.physics_ok for episode in episodes], dtype=bool)
        left = self._before[list(slots)].copy()
        seen = [episode for episode in episodes if episode.physics_ok]
        if seen:
            snapshots = [episode.snapshot for episode in seen]
            arrays = [
                torch.from_numpy(np.stack([getattr(s, name) for s in snapshots]).astype(float))
                for name in ("particle_q", "body_q")
            ]
            layouts = [episode.layout for episode in seen]
            with torch.no_grad():
                left[trusted] = self._worlds.task.remaining(layouts, snapshots, *arrays).numpy()
        return left
