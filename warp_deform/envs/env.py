"""The Gymnasium environment: one episode of a task, one pick-and-place a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ..planning.demonstrators import demonstrator as find_demonstrator
from ..tasks.task import Action, Task
from ..worlds.acting import Acting, ActionMode, reachable
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.observing import Observing, ObsMode
from ..worlds.rewards import RewardMode, Rewards
from ..worlds.spaces import information
from ..worlds.worlds import Worlds
from .reset_options import single_start
from .worlds_view import WorldsView, check_render_mode

__all__ = ["PickPlaceEnv"]


class PickPlaceEnv(gymnasium.Env[Any, np.ndarray]):
    """Rearrange cables, fabrics, bags or boxes by picking and placing, in the episodes of a task.

        env = gymnasium.make("WarpDeform/CableRing-v3")
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

    Reward is the change of the score, or as `reward_mode` says. An episode terminates when the task
    is solved or over without success by its rules (`Task.ended`), and is truncated after
    `max_actions`, or as soon as a guard of the solver says that the state cannot be trusted.
    `Observing` and `spaces.information` say what observations and infos hold.

    A seed names an episode: the same bits in any environment, alone or in a vector. A reset without
    one draws the episode's seed from `np_random` (1,000,000 and up) and tells it in `info`.

    Args:
        task: a name, see `warp-deform list`, or a `Task` of your own
        robot: "ur5" or "panda"
        render_mode: None, or "rgb_array" for `render` to draw table, objects and arm (360, 640, 3)
        obs_mode: "images", "state", "state_dict", "rgb", "rgbd" or "rgb+state", see `Observing`
        action_mode: "metric", or "normalized" for actions from -1 to 1
        snap: a pick that would meet nothing is drawn to the nearest thing so far away at most [m];
            infos then have `pick_shift`, how far it was [m]
        reward_mode: "score", "dense", "normalized_dense", "sparse" or "none", see `Rewards`
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}

    def __init__(
        self,
        task: str | Task,
        *,
        robot: str = "ur5",
        render_mode: str | None = None,
        obs_mode: ObsMode = "images",
        action_mode: ActionMode = "metric",
        snap: float = 0.0,
        reward_mode: RewardMode = "score",
    ) -> None:
        self.render_mode = check_render_mode(render_mode, self.metadata)
        self.worlds = Worlds(task, 1, robot=robot)
        self.observing = Observing(self.worlds, obs_mode)
        self.acting = Acting(self.worlds, action_mode, snap)
        self.rewards = Rewards(self.worlds, reward_mode)
        self.observation_space = self.observing.space
        self.action_space = self.acting.space
        self._view = WorldsView(self.worlds)
        self._running = False

    @property
    def task(self) -> Task:
        """The task that is played."""
        return self.worlds.task

    @property
    def task_description(self) -> str:
        """What is to be done, as a sentence for policies that read one."""
        return self.task.instruction

    @property
    def _max_episode_steps(self) -> int:
        """What others ask for by this name."""
        return self.task.max_actions

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the episode that `seed` names.

        Args:
            options: {"goal": ...} for a goal-conditioned task, a `Goal`, the path of an episode
                file (its last state is the goal) or of a folder of them (chosen by the seed); by
                default the objects are placed at the target that the seed drew

        Raises:
            InputError: an option is unknown, or the goal is not this task's.
        """
        super().reset(seed=seed)
        number, goals = single_start(self.task, seed, options, self.np_random)
        self._running = False
        self.worlds.reset({0: number}, goals=goals)
        self._run = EpisodeRun[Any](number, episode_rng(number, DEMONSTRATOR_STREAM))
        self.rewards.start([0])
        self._running = True
        return self.observing.of(0), information(self.worlds, 0, outcome=None)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Pick and place once, and wait for rest.

        Raises:
            InputError: the action is not in the action space; nothing is clamped.
            gymnasium.error.ResetNeeded: no episode runs.
        """
        if not self._running:
            raise ResetNeeded("no episode runs: call reset() first")
        said = self.acting.of(action)
        drawn = self.acting.drawn(0, said)
        report = self.worlds.step({0: drawn})[0]
        info = information(self.worlds, 0, outcome=report.outcome)
        info |= self.acting.shift(said, drawn)
        reward = float(self.rewards.take([0])[0])
        terminated, truncated = ending(self.worlds, 0, info)
        self._running = not (terminated or truncated)
        return self.observing.of(0), reward, terminated, truncated, info

    def demonstrate(self, demonstrator: str = "scripted") -> Action | None:
        """What a demonstrator (scripted, visible, mpc or planner) would do; it sees the state.

        None when it sees nothing to do or would reach beyond the action space. It is said as
        `action_mode` has it.

        Raises:
            InputError: there is no such demonstrator.
            gymnasium.error.ResetNeeded: no episode runs.
        """
        if not self._running:
            raise ResetNeeded("no episode runs: call reset() first")
        action = find_demonstrator(demonstrator)(self.worlds, {0: self._run})[0]
        return self.acting.said(action) if reachable(action) else None

    def render(self) -> np.ndarray | None:
        """The scene (360, 640, 3) uint8, black if it cannot be drawn; None without render mode."""
        return self._view.render(self.render_mode)


def ending(worlds: Worlds, slot: int, info: Mapping[str, Any]) -> tuple[bool, bool]:
    """Whether an episode has terminated (by its task's rules) and whether it is truncated."""
    # what a guard has found wrong has no end
    terminated = bool(info["physics_ok"] and worlds.episodes[slot].ended)
    over = info["actions"] >= worlds.task.max_actions or not info["physics_ok"]
    return terminated, bool(over and not terminated)
