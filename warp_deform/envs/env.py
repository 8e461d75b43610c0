"""The Gymnasium environment: one episode of a task, one pick-and-place a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ..errors import InputError
from ..planning.demonstrators import demonstrator as find_demonstrator
from ..rendering.scene_view import ArmMeshes, SceneView
from ..tasks.task import Action, Task
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.spaces import action_space, check_action, information, observation, observation_space
from ..worlds.worlds import Worlds
from .reset_options import check_options, goal_for, next_seed

__all__ = ["PickPlaceEnv", "WorldsView"]

_FRAME = (360, 640)  # [pixels] rows, columns


class PickPlaceEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """Rearrange cables, fabrics, bags or boxes by picking and placing, in the episodes of a task.

        env = gymnasium.make("WarpDeform/CableRing-v2")
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

    Reward is the change of the score. An episode terminates when the task is solved or over without
    success by its rules (`Task.ended`), and is truncated after `max_actions`, or as soon as a guard
    of the solver says that the state cannot be trusted. `spaces.observation` and
    `spaces.information` say what observations and infos hold.

    A seed names an episode: the same bits in any environment, alone or in a vector. A reset without
    one draws the episode's seed from `np_random` (1,000,000 and up) and tells it in `info`.

    Args:
        task: a name, see `warp-deform list`, or a `Task` of your own
        robot: "ur5" or "panda"
        render_mode: None, or "rgb_array" for `render` to draw table, objects and arm (360, 640, 3)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}

    def __init__(
        self, task: str | Task, *, robot: str = "ur5", render_mode: str | None = None
    ) -> None:
        self.render_mode = check_render_mode(render_mode, self.metadata)
        self.worlds = Worlds(task, 1, robot=robot)
        self.observation_space = observation_space(self.task)  # type: ignore[assignment]
        self.action_space = action_space()
        self._view = WorldsView(self.worlds)
        self._running = False

    @property
    def task(self) -> Task:
        """The task that is played."""
        return self.worlds.task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start the episode that `seed` names.

        Args:
            options: {"goal": ...} for a goal-conditioned task, a `Goal`, the path of an episode
                file (its last state is the goal) or of a folder of them (chosen by the seed); by
                default the objects are placed at the target that the seed drew

        Raises:
            InputError: an option is unknown, or the goal is not this task's.
        """
        super().reset(seed=seed)
        number = int(seed) if seed is not None else next_seed(self.np_random)
        given = check_options(options, "goal").get("goal")
        goals = {} if given is None else {0: goal_for(self.task, given, seed=number)}
        self._running = False
        self.worlds.reset({0: number}, goals=goals)
        self._run = EpisodeRun[Any](number, episode_rng(number, DEMONSTRATOR_STREAM))
        self._score = self.worlds.score(0)
        self._running = True
        return observation(self.worlds, 0), information(self.worlds, 0, outcome=None)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Pick and place once, and wait for rest.

        Raises:
            InputError: the action is not in the action space; nothing is clamped.
            gymnasium.error.ResetNeeded: no episode runs.
        """
        if not self._running:
            raise ResetNeeded("no episode runs: call reset() first")
        report = self.worlds.step({0: check_action(action)})[0]
        info = information(self.worlds, 0, outcome=report.outcome)
        reward = info["score"] - self._score
        self._score = info["score"]
        terminated, truncated = ending(self.worlds, 0, info)
        self._running = not (terminated or truncated)
        return observation(self.worlds, 0), reward, terminated, truncated, info

    def demonstrate(self, demonstrator: str = "scripted") -> Action | None:
        """What a demonstrator (scripted, visible, mpc or planner) would do; it sees the state.

        None when it sees nothing to do or would reach beyond the action space.

        Raises:
            InputError: there is no such demonstrator.
            gymnasium.error.ResetNeeded: no episode runs.
        """
        if not self._running:
            raise ResetNeeded("no episode runs: call reset() first")
        action = find_demonstrator(demonstrator)(self.worlds, {0: self._run})[0]
        return action if action is not None and self.action_space.contains(action) else None

    def render(self) -> np.ndarray | None:
        """The scene (360, 640, 3) uint8, black if it cannot be drawn; None without render mode."""
        if self.render_mode is None:
            return None
        if not self.worlds.episodes:
            raise ResetNeeded("nothing to draw: call reset() first")
        return self._view.frame(0)


class WorldsView:
    """Draws slots of `worlds` for people, the arm in its home posture."""

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds
        self._scene: SceneView | None = None

    def frame(self, slot: int) -> np.ndarray:
        """Picture (360, 640, 3) uint8 of a slot."""
        if self._scene is None:
            robot = self._worlds.robot
            self._scene = SceneView(_FRAME)
            self._links = ArmMeshes(robot.meshes()).at(robot.link_poses(robot.home_q))
        episode = self._worlds.episodes[slot]
        state = episode.snapshot.particle_q, episode.snapshot.body_q
        if not all(np.isfinite(array).all() for array in state):
            return np.zeros((*_FRAME, 3), np.uint8)
        return self._scene.render(episode.drawables, *state, self._links)


def ending(worlds: Worlds, slot: int, info: Mapping[str, Any]) -> tuple[bool, bool]:
    """Whether an episode has terminated (by its task's rules) and whether it is truncated."""
    # what a guard has found wrong has no end
    terminated = bool(info["physics_ok"] and worlds.episodes[slot].ended)
    over = info["actions"] >= worlds.task.max_actions or not info["physics_ok"]
    return terminated, bool(over and not terminated)


def check_render_mode(mode: str | None, metadata: Mapping[str, Any]) -> str | None:
    """The mode; InputError when it is unknown."""
    if mode is not None and mode not in metadata["render_modes"]:
        raise InputError(f"render_mode is None or 'rgb_array', not {mode!r}")
    return mode
