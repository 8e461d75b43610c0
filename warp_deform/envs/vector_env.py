"""The vector environment: episodes of one task side by side in the lanes of one simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from ..errors import InputError
from ..planning.demonstrators import demonstrator as find_demonstrator
from ..tasks.task import Action, Task
from ..worlds.acting import Acting, ActionMode, reachable
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.observing import Observing, ObsMode
from ..worlds.rewards import RewardMode, Rewards
from ..worlds.spaces import information
from ..worlds.worlds import Worlds
from .backends import Backend
from .env import ending
from .lane_vector_env import LaneVectorEnv, Stepped
from .reset_options import GoalOption, goal_for

__all__ = ["PickPlaceVectorEnv"]


class PickPlaceVectorEnv(LaneVectorEnv):
    """`num_envs` episodes of a task, simulated together: the fast way to gather experience.

        envs = gymnasium.make_vec("WarpDeform/CableRing-v3", num_envs=16)
        observations, infos = envs.reset(seed=0)          # episodes 0 to 15
        observations, rewards, terminations, truncations, infos = envs.step(actions)

    An episode has the same bits as in `PickPlaceEnv` with the same seed, whatever the number of
    environments and its place among them; so have the episodes that follow it by autoreset.

    Infos are dictionaries of arrays, as Gymnasium's.

    Args:
        autoreset_mode: "NextStep" (Gymnasium's default: the step after an episode's end ignores the
            action and resets), "SameStep" (the last observation is in infos["final_obs"], its info
            in infos["final_info"]) or "Disabled" (reset ended ones with options={"reset_mask":
            mask})
        task: see `PickPlaceEnv`
        backend: "numpy", or "torch" for observations, rewards and ends as tensors; actions may be
            either in both
        robot: see `PickPlaceEnv`
        render_mode: see `PickPlaceEnv`
        obs_mode: see `PickPlaceEnv`
        action_mode: see `PickPlaceEnv`
        snap: see `PickPlaceEnv`
        reward_mode: see `PickPlaceEnv`
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 2,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: str | Task,
        num_envs: int = 1,
        *,
        robot: str = "ur5",
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        backend: Backend = "numpy",
        obs_mode: ObsMode = "images",
        action_mode: ActionMode = "metric",
        snap: float = 0.0,
        reward_mode: RewardMode = "score",
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, got {num_envs}")
        worlds = Worlds(task, num_envs, robot=robot)
        self.observing = Observing(worlds, obs_mode)
        self.acting = Acting(worlds, action_mode, snap)
        self.rewards = Rewards(worlds, reward_mode)
        self._runs: dict[int, EpisodeRun[Any]] = {}
        super().__init__(
            worlds,
            observation=self.observing.space,
            action=self.acting.space,
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            backend=backend,
        )

    @property
    def _max_episode_steps(self) -> int:
        return self.task.max_actions

    def demonstrate(self, demonstrator: str = "scripted") -> list[Action | None]:
        """What a demonstrator would do now in every environment, as in `PickPlaceEnv`.

        None where the episode is over, and where `PickPlaceEnv` has None.

        Raises:
            InputError: there is no such demonstrator.
            gymnasium.error.ResetNeeded: there is no episode yet.
        """
        self._check_begun("no episodes run: call reset() first")
        running = {i: run for i, run in self._runs.items() if not self.ended[i]}
        chosen = find_demonstrator(demonstrator)(self.worlds, running)
        actions = [chosen.get(i) for i in range(self.num_envs)]
        return [self.acting.said(action) if reachable(action) else None for action in actions]

    def _begin(self, seeds: Mapping[int, int], goals: Mapping[int, GoalOption]) -> None:
        made = {i: goal_for(self.task, goal, seed=seeds[i]) for i, goal in goals.items()}
        self.worlds.reset(seeds, goals=made)
        for i, number in seeds.items():
            self._runs[i] = EpisodeRun(number, episode_rng(number, DEMONSTRATOR_STREAM))
        self.rewards.start(list(seeds))

    def _checked(self, i: int, action: np.ndarray) -> np.ndarray:
        return self.acting.of(action, name=f"action of environment {i}")

    def _act(self, actions: Mapping[int, np.ndarray]) -> Mapping[int, Stepped]:
        drawn = {i: self.acting.drawn(i, action) for i, action in actions.items()}
        reports = self.worlds.step(drawn)
        rewards = dict(zip(reports, self.rewards.take(list(reports)), strict=True))
        steps = {}
        for i, report in reports.items():
            info = information(self.worlds, i, outcome=report.outcome)
            info |= self.acting.shift(actions[i], drawn[i])
            steps[i] = Stepped(float(rewards[i]), *ending(self.worlds, i, info), info)
        return steps

    def _see(self, i: int) -> Any:
        return self.observing.of(i)

    def _tell(self, i: int) -> dict[str, Any]:
        return information(self.worlds, i, outcome=None)
