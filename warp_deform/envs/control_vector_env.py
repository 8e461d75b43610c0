"""The vector environment of control at a fixed rate: episodes in the lanes of one simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
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

if TYPE_CHECKING:
    from torch import Tensor

    from ..control.tensor_worlds import TensorControlWorlds

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
        differentiable: observations and rewards have a graph that leads back to the actions, see
            `TensorControlWorlds`; `detach` cuts it. This needs the backend "torch", and is for
            the default modes of action, observation and reward
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
        differentiable: bool = False,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, got {num_envs}")
        options: dict[str, Any] = {
            "robot": robot, "control_mode": control_mode, "reward_mode": reward_mode,
            "start": start, "release": release, "config": control, "horizon": horizon,
        }  # fmt: skip
        self.tensors: TensorControlWorlds | None = None
        if differentiable:
            self.tensors = _differentiable(task, num_envs, backend, obs_mode, options)
        self.control = self.tensors or ControlWorlds(task, num_envs, **options)
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

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """See `LaneVectorEnv.step`; with `differentiable` actions may be a tensor with a graph.

        What is told in infos is then told of all environments: success, is_success, physics_ok,
        steps.
        """
        if self.tensors is None:
            return super().step(actions)
        return self._tensor_step(self.tensors, actions)

    def _tensor_step(
        self, tensors: TensorControlWorlds, actions: Any
    ) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        import torch

        self._check_begun("no episodes run: call reset() first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self.ended.all():
            raise ResetNeeded("all episodes are over: reset them")
        actions = torch.as_tensor(actions)
        for i, row in enumerate(actions.detach().numpy()):
            self._checked(i, row)
        waiting = np.flatnonzero(self.ended).tolist()
        done = tensors.advance(actions)
        infos: dict[str, Any] = {
            "success": done.success, "is_success": done.success.copy(),
            "physics_ok": tensors.trusted, "steps": tensors.steps.copy(),
        }  # fmt: skip
        over = done.terminated | done.truncated
        if self.autoreset_mode is AutoresetMode.DISABLED:
            # an episode that is over rests until all are: a graph ends where a reset begins
            self.ended = self.ended | over
        else:
            if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
                infos |= {"final_obs": tensors.observe(), "_final_obs": over.copy()}
                waiting = np.flatnonzero(over).tolist()
            self.ended = over
            self._start(dict.fromkeys(waiting), {})
        ends = (torch.from_numpy(part.copy()) for part in (done.terminated, done.truncated))
        return tensors.observe(), done.rewards, *ends, infos

    def detach(self) -> None:
        """Cut the graph here, and free what is recorded.

        Raises:
            InputError: the environment is not differentiable.
        """
        if self.tensors is None:
            raise InputError("nothing is recorded: make the environment with differentiable=True")
        self.tensors.detach()

    def _observations(self) -> Tensor | Any:
        return super()._observations() if self.tensors is None else self.tensors.observe()

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


def _differentiable(
    task: str | Task, count: int, backend: str, obs_mode: str, options: dict[str, Any]
) -> TensorControlWorlds:
    """The worlds of a differentiable environment.

    Raises:
        InputError: a backend or a mode that has no derivatives.
    """
    from ..control.tensor_worlds import TensorControlWorlds

    for name, value, only in (("backend", backend, "torch"), ("obs_mode", obs_mode, "state")):
        if value != only:
            raise InputError(f'differentiable=True needs {name}="{only}", not {value!r}')
    return TensorControlWorlds(task, count, **options)
