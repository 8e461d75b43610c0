"""A trained policy at the page: it acts in the person's place and shows where it looks."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError
from warp_deform.page.players import Player, Sight
from warp_deform.tasks.task import Action
from warp_deform.worlds.loop import EpisodeRun
from warp_deform.worlds.worlds import Worlds

from ..evaluation.play import observation_of
from ..evaluation.video import heat_maps
from ..policy.policy import ImagePolicy, RetryingPolicy, StatePolicy, load_policy

__all__ = ["PolicyPlayer"]


class PolicyPlayer:
    """A policy that acts as `warp-deform eval` has it act; see `page.players.Player`.

    Args:
        path: snapshot, or a training run's folder
        task: name of the task that is played

    Raises:
        InputError: there is no policy, or it is another task's.
    """

    def __init__(self, path: Path, *, task: str) -> None:
        self._policy = load_policy(path)
        trained = self._policy.description.task
        if trained != task:
            raise InputError(f"{path} is a policy of {trained}; play that task, not {task}")
        self.looks = isinstance(self._policy, ImagePolicy)
        self.name = self._policy.description.agent
        self.begin()

    def begin(self) -> None:
        """Forget the episode."""
        policy = self._policy
        self._acting: RetryingPolicy | StatePolicy = (
            RetryingPolicy(policy) if isinstance(policy, ImagePolicy) else policy
        )

    def aside(self) -> Player:
        """See `Player.aside`."""
        other = copy.copy(self)
        if isinstance(self._acting, RetryingPolicy):
            other._acting = copy.copy(self._acting)
            other._acting._memory = copy.deepcopy(self._acting._memory)
        return other

    def choose(self, worlds: Worlds, run: EpisodeRun[Any]) -> Action | None:
        """See `Player.choose`."""
        return self._acting.act(observation_of(worlds, 0, self._policy), rng=run.rng)

    def sight(self, worlds: Worlds, action: Action) -> Sight | None:
        """Where the network looks; what the memory of missed picks avoids is not left out."""
        if not isinstance(self._policy, ImagePolicy):
            return None
        maps = heat_maps(self._policy, observation_of(worlds, 0, self._policy), action)
        return Sight(maps.pick, maps.place)
