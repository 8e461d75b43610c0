"""The vector environment of control at a fixed rate: episodes in the lanes of one simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from ..control.control_worlds import ControlWorlds, Release, Start
from ..control.modes import ControlConfig, ControlMode
from ..errors import InputError
from ..tasks.task import Task
from ..worlds.observing import Observing, ObsMode
from ..worlds.rewards import RewardMode
from .backends import Backend
from .control_env import ControlNumbers, TipActions, check_tip_action, control_information
from .lane_vector_env import LaneVectorEnv, Stepped
from .reset_options import GoalOption, goal_for

__all__ = ["ControlVectorEnv"]


class ControlVectorEnv(LaneVectorEnv):
    """`num_envs` episodes that are controlled together, each as in `ControlEnv` to the bit.

        envs = gymnasium.make_vec("WarpDeform/Whip-v1", num_envs=16)
        observations, infos = envs.reset(seed=0)          # episodes 0 to 15
        observations, rewards, terminations, truncations, infos = envs.step(actions)

    Args:
        task: see `ControlEnv`, as are the arguments that `PickPlaceVectorEnv` has not
        num_envs: see `PickPlaceVectorEnv`
        autoreset_mode: see `PickPlaceVectorEnv`
        backend: see `PickPlaceVectorEnv`
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 20,
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
        obs_mode: ObsMode = "state",
        control_mode: ControlMode = "tip_delta_position",
        reward_mode: RewardMode = "dense",
        start: Start = "free",
        release: Release = "rest",
        control: ControlConfig | None = None,
        horizon: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, got {num_envs}")
        self.control = ControlWorlds(
            task, num_envs, robot=robot, mode=control_mode, reward_mode=reward_mode, start=start,
            release=release, config=control, horizon=horizon,
        )  # fmt: skip
        self.observing = Observing(self.control.worlds, obs_mode, ControlNumbers(self.control))
        super().__init__(
            self.control.worlds,
            observation=self.observing.space,
            action=TipActions(control_mode, self.control.config),
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            backend=backend,
            arm_follows=True,
        )
        self.metadata = {**self.metadata, "render_fps": self.control.config.rate}

    @property
    def _max_episode_steps(self) -> int:
        return self.control.horizon

    def _begin(self, seeds: Mapping[int, int], goals: Mapping[int, GoalOption]) -> None:
        made = {i: goal_for(self.task, goal, seed=seeds[i]) for i, goal in goals.items()}
        self.control.reset(seeds, goals=made)

    def _checked(self, i: int, action: np.ndarray) -> np.ndarray:
        width = self.control.targets.width
        return check_tip_action(action, width, name=f"action of environment {i}")

    def _act(self, actions: Mapping[int, np.ndarray]) -> Mapping[int, Stepped]:
        return {
            i: Stepped(
                done.reward,
                done.terminated,
                done.truncated,
                control_information(self.control, i, done),
            )
            for i, done in self.control.step(actions).items()
        }

    def _see(self, i: int) -> Any:
        return self.observing.of(i)

    def _tell(self, i: int) -> dict[str, Any]:
        return control_information(self.control, i, None)
