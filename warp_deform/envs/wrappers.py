"""The paper's privileged rule as a wrapper: the lift follows from the task's stage.

The original keeps a hidden stage per task, with a height and a speed each, and reads it from the
simulator's segmentation at the pick point. Without the wrapper the lift is part of the action.
Every info says which was used: `stage_rule` is "action" or "privileged".

Source: Seita et al., ICRA 2021, appendix on the action primitive.
"""

from __future__ import annotations

from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ..errors import InputError
from ..rendering.pixels import SHAPE
from ..support.checked import real_array
from ..tasks.task import Stage, Task
from ..worlds.spaces import action_space
from ..worlds.worlds import Worlds
from .env import PickPlaceEnv
from .vector_env import PickPlaceVectorEnv

__all__ = ["PrivilegedStage", "VectorPrivilegedStage", "stage_at"]

_RULE = "privileged"


class PrivilegedStage(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Takes the lift out of the action, Box (6,), and fills in that of the task's stage.

    env = PrivilegedStage(gymnasium.make("WarpDeform/CableRing-v3"))
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        if not isinstance(env.unwrapped, PickPlaceEnv):
            raise InputError(f"PrivilegedStage wraps a PickPlaceEnv, not {env.unwrapped}")
        _check_metric(env.unwrapped)
        self.action_space = _without_lift()
        self._stage: Stage | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in the task's first stage."""
        self._stage = None
        seen, info = self.env.reset(seed=seed, options=options)
        return seen, {**info, "stage_rule": _RULE}

    def step(self, action: ArrayLike) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Pick and place with the stage's lift; action (6,)."""
        worlds = cast(PickPlaceEnv, self.unwrapped).worlds
        pose = real_array(action, (6,), name="action under the privileged rule")
        if worlds.episodes:
            self._stage = stage_at(worlds, 0, pose, self._stage)
        lift = self._stage.lift if self._stage else 0.0
        seen, reward, terminated, truncated, info = self.env.step(np.append(pose, lift))
        return seen, reward, terminated, truncated, {**info, "stage_rule": _RULE}


class VectorPrivilegedStage(VectorWrapper[Any, Any, Any, Any, Any]):
    """`PrivilegedStage` for `PickPlaceVectorEnv`: actions (num_envs, 6)."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        if not isinstance(env.unwrapped, PickPlaceVectorEnv):
            raise InputError(f"VectorPrivilegedStage wraps a PickPlaceVectorEnv, not {env}")
        _check_metric(env.unwrapped)
        self.single_action_space = _without_lift()
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        self._stages: list[Stage | None] = [None] * env.num_envs

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes in the task's first stage."""
        seen, infos = self.env.reset(seed=seed, options=options)
        for i in np.flatnonzero(infos["_seed"]):
            self._stages[i] = None
        return seen, _mark(infos)

    def step(self, actions: ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Pick and place with every environment's lift; actions (num_envs, 6)."""
        env = cast(PickPlaceVectorEnv, self.unwrapped)
        poses = real_array(actions, (self.num_envs, 6), name="actions under the privileged rule")
        lifts = np.full(self.num_envs, float(env.single_action_space.low[6]))  # type: ignore[attr-defined]
        for i in range(self.num_envs):
            if i in env.worlds.episodes and not env.ended[i]:
                stage = self._stages[i] = stage_at(env.worlds, i, poses[i], self._stages[i])
                lifts[i] = stage.lift
        seen, rewards, terminations, truncations, infos = self.env.step(
            np.column_stack([poses, lifts])
        )
        for over in np.flatnonzero(terminations | truncations):
            self._stages[over] = None
        return seen, rewards, terminations, truncations, _mark(infos)


def stage_at(worlds: Worlds, slot: int, pose: np.ndarray, previous: Stage | None) -> Stage:
    """The stage that the task's rule gives for a pick at x, y of `pose` (6,)."""
    task: Task = worlds.task
    snapshot = worlds.episodes[slot].snapshot
    segment = 0
    if np.isfinite(pose[:2]).all():  # what is not finite is for the environment to refuse
        row, column = task.grid.to_pixel(pose[:2])
        if 0 <= row < SHAPE[0] and 0 <= column < SHAPE[1]:
            segment = int(snapshot.images.segmentation[row, column])
    return task.privileged_stage(segment, snapshot, previous)


def _check_metric(env: PickPlaceEnv | PickPlaceVectorEnv) -> None:
    if env.acting.mode != "metric":
        raise InputError("the privileged rule takes actions in metres: make it without action_mode")


def _without_lift() -> spaces.Box:
    full = action_space()
    return spaces.Box(full.low[:6], full.high[:6], dtype=np.float64)


def _mark(infos: dict[str, Any]) -> dict[str, Any]:
    """The infos with the rule that was used, also in those of episodes that ended."""
    if "stage_rule" in infos:
        marked = np.where(infos["_stage_rule"], _RULE, infos["stage_rule"])
        infos["stage_rule"] = marked.astype(object)
    if "final_info" in infos:
        _mark(infos["final_info"])
    return infos
