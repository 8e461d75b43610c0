"""The Gymnasium environment of control at a fixed rate, 20 Hz by default."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ..control.control_worlds import ControlStep, ControlWorlds, Release, Start
from ..control.modes import CONTROL_MODES, ControlConfig, ControlMode
from ..control.numbers import control_numbers
from ..errors import InputError
from ..support.checked import real_array
from ..tasks.task import Task
from ..worlds.observing import Observing, ObsMode, goal_shape
from ..worlds.rewards import RewardMode
from .reset_options import single_start
from .worlds_view import WorldsView, check_render_mode

__all__ = ["ControlEnv", "ControlNumbers", "TipActions"]

_STEP = float(np.spacing(np.float32(1.0)))


class TipActions(spaces.Box):
    """Box (A,) float32 from -1 to 1, that says in words what the numbers mean.

    Attributes:
        names: of the numbers
        description: what they do, and what is done with targets that nothing can follow
    """

    def __init__(self, mode: ControlMode, config: ControlConfig) -> None:
        self.names = CONTROL_MODES[mode]
        super().__init__(-1.0, 1.0, (len(self.names),), np.float32)
        self.description = (
            f"{', '.join(self.names)}: at {config.rate:g} Hz, an action of length 1 leads the tip "
            f"at {config.max_speed:g} m/s, a longer one no faster, a turn of 1 at "
            f"{config.max_turn:g} rad/s. hold above 0 takes the nearest thing under the tip and "
            "keeps it; else it lets go. A target under the table, or lower than what is held may "
            "lie, or out of the arm's reach, is led back smoothly (softplus, widths 2 mm and 1 cm)."
        )


def check_tip_action(action: ArrayLike, width: int, *, name: str = "action") -> np.ndarray:
    """The action as (width,) float64; one rounding step of float32 beyond a limit lies on it.

    Raises:
        InputError: another shape, no real numbers, or a value that is not from -1 to 1.
    """
    values = real_array(action, (width,), name=name)
    if not (np.abs(values) <= 1 + _STEP).all():  # also when one is not a number
        raise InputError(f"{name}: {values} is not within -1 to 1")
    return np.clip(values, -1.0, 1.0)


class ControlNumbers:
    """What "state_dict" holds under control; particles are told relative to the tip."""

    agent: tuple[str, ...] = ("tip", "holding")

    def __init__(self, control: ControlWorlds) -> None:
        self._control = control
        world = control.worlds.solver.data.topologies[0]
        self.shapes = {
            "tip": (4,),
            "holding": (1,),
            "particle_q": (world.particle_count, 3),
            "particle_qd": (world.particle_count, 3),
            "body_q": (world.body_count, 7),
            "goal": goal_shape(control.worlds),
            "time": (1,),
        }

    def of(self, slot: int) -> dict[str, np.ndarray]:
        """The entries of a slot."""
        episode = self._control.worlds.episodes[slot]
        snapshot = episode.snapshot
        return control_numbers(
            tip=episode.tip,
            holding=self._control.holding(slot),
            particle_q=snapshot.particle_q,
            particle_qd=snapshot.particle_qd,
            body_q=snapshot.body_q,
            goal=episode.layout.targets,
            time=self._control.steps[slot] / self._control.horizon,
        )


class ControlEnv(gymnasium.Env[Any, np.ndarray]):
    """Lead a tip at 20 Hz that takes, carries and lets go, in the episodes of a task.

        env = gymnasium.make("WarpDeform/CableRing-Control-v1", obs_mode="state")
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

    An episode terminates when it was solved for 5 steps running (swings only at their end), or when
    a guard of the solver fires: its reward is then 0 and `physics_ok` False. It is truncated after
    `_max_episode_steps`. A seed names an episode, with the same bits here and in a vector.

    Args:
        task: a name, or a `Task` of your own
        robot: "ur5" or "panda"
        render_mode: see `PickPlaceEnv`
        obs_mode: see `Observing`; "state_dict" has `tip`, `holding`, `particle_q` relative to the
            tip, `particle_qd`, `body_q`, `goal`, `time`
        control_mode: see `CONTROL_MODES`
        reward_mode: see `Rewards`; off "dense" and "normalized_dense" go 0.01 |action - last|^2
        start: "free" or "held", see `ControlWorlds`
        release: "rest" or "moving", see `ControlWorlds`
        control: rate and speeds; None: the task's
        horizon: control steps of an episode; None: the task's, 10 s where it says nothing
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        task: str | Task,
        *,
        robot: str = "ur5",
        render_mode: str | None = None,
        obs_mode: ObsMode = "state",
        control_mode: ControlMode = "tip_delta_position",
        reward_mode: RewardMode = "dense",
        start: Start = "free",
        release: Release = "rest",
        control: ControlConfig | None = None,
        horizon: int | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode, self.metadata)
        self.control = ControlWorlds(
            task, robot=robot, control_mode=control_mode, reward_mode=reward_mode, start=start,
            release=release, config=control, horizon=horizon,
        )  # fmt: skip
        self.worlds = self.control.worlds
        self.metadata = {**self.metadata, "render_fps": self.control.config.rate}
        self.observing = Observing(self.worlds, obs_mode, ControlNumbers(self.control))
        self.observation_space = self.observing.space
        self.action_space = TipActions(control_mode, self.control.config)
        self._view = WorldsView(self.worlds, arm_follows=True)
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
        return self.control.horizon

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the episode that `seed` names; the option is {"goal": ...}, see `PickPlaceEnv`.

        Raises:
            InputError: an option is unknown, or the goal is not this task's.
        """
        super().reset(seed=seed)
        number, goals = single_start(self.task, seed, options, self.np_random)
        self._running = False
        self.control.reset({0: number}, goals=goals)
        self._running = True
        return self.observing.of(0), control_information(self.control, 0, None)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Lead the tip for one control step.

        Raises:
            InputError: the action is not in the action space.
            gymnasium.error.ResetNeeded: no episode runs.
        """
        if not self._running:
            raise ResetNeeded("no episode runs: call reset() first")
        checked = check_tip_action(action, self.control.targets.width)
        done = self.control.step({0: checked})[0]
        self._running = not (done.terminated or done.truncated)
        info = control_information(self.control, 0, done)
        return self.observing.of(0), done.reward, done.terminated, done.truncated, info

    def render(self) -> np.ndarray | None:
        """The scene (360, 640, 3) uint8, black if it cannot be drawn; None without render mode."""
        return self._view.render(self.render_mode)


def control_information(
    control: ControlWorlds, slot: int, done: ControlStep | None
) -> dict[str, Any]:
    """What is known of a slot beyond the observation: not for policies.

    success and is_success, score, physics_ok, problems, state_hash, sim_seconds [s], seed,
    discarded_starts, steps so far, holding.

    Args:
        done: the last step; None after a reset
    """
    worlds = control.worlds
    episode = worlds.episodes[slot]
    success = bool(worlds.solved(slot)) if done is None else done.success
    return {
        "success": success,
        "is_success": success,
        "score": float(worlds.score(slot)),
        "physics_ok": bool(episode.physics_ok),
        "problems": "; ".join(map(str, episode.problems)),
        "state_hash": worlds.hash(slot),
        "sim_seconds": float(episode.sim_seconds),
        "seed": int(episode.seed),
        "discarded_starts": int(episode.discarded_starts),
        "steps": int(control.steps[slot]),
        "holding": control.holding(slot),
    }
