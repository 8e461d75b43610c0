"""The vector environment: episodes of one task side by side in the lanes of one simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ..errors import InputError
from ..planning.demonstrators import demonstrator as find_demonstrator
from ..support.checked import real_array
from ..tasks.task import Action, Task
from ..worlds.acting import Acting, ActionMode, reachable
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.observing import Observing, ObsMode
from ..worlds.rewards import RewardMode, Rewards
from ..worlds.spaces import information
from ..worlds.worlds import Worlds
from .backends import Backend, as_backend, check_backend, stacked
from .env import WorldsView, check_render_mode, ending
from .named_calls import NamedCalls
from .reset_options import IGNORED, GoalOption, check_options, goal_for, next_seed

__all__ = ["PickPlaceVectorEnv"]

Seeds = int | Sequence[int | None] | None


class PickPlaceVectorEnv(NamedCalls, VectorEnv[Any, Any, Any]):
    """`num_envs` episodes of a task, simulated together: the fast way to gather experience.

        envs = gymnasium.make_vec("WarpDeform/CableRing-v2", num_envs=16)
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
        self.render_mode = check_render_mode(render_mode, self.metadata)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self.worlds = Worlds(task, num_envs, robot=robot)
        self.backend = check_backend(backend)
        self.observing = Observing(self.worlds, obs_mode)
        self.acting = Acting(self.worlds, action_mode, snap)
        self.rewards = Rewards(self.worlds, reward_mode)
        self.single_observation_space = self.observing.space
        self.single_action_space = self.acting.space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.ended = np.zeros(num_envs, bool)
        """(num_envs,) bool: which episodes are over and wait for their reset."""
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._runs: dict[int, EpisodeRun[Any]] = {}
        self._view = WorldsView(self.worlds)

    @property
    def task(self) -> Task:
        """The task that is played."""
        return self.worlds.task

    @property
    def task_description(self) -> str:
        """See `PickPlaceEnv`."""
        return self.task.instruction

    @property
    def _max_episode_steps(self) -> int:
        return self.task.max_actions

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment.

        Args:
            seed: one seed an environment, or a number s for s, s + 1, ...; None goes on with every
                environment's own sequence
            options: "goal" as for `PickPlaceEnv`, or a list of one an environment (None:
                constructed); "reset_mask" (num_envs,) bool: which environments to reset, all others
                go on

        Raises:
            InputError: a wrong number of seeds or goals, an unknown option, a goal of another task.
        """
        given = check_options(options, "goal", "reset_mask", *IGNORED)
        seeds = self._seeds(seed)
        slots = self._masked(given.get("reset_mask"))
        goals = given.get("goal")
        if not isinstance(goals, list | tuple):
            goals = [goals] * self.num_envs
        if len(goals) != self.num_envs:
            raise InputError(
                f"{self.num_envs} environments need {self.num_envs} goals, got {len(goals)}"
            )
        for i in slots:
            if seeds[i] is not None:
                self._rngs[i] = seeding.np_random(seeds[i])[0]
        self._start({i: seeds[i] for i in slots}, {i: goals[i] for i in slots if goals[i]})
        infos: dict[str, Any] = {}
        for i in slots:
            self._add_info(infos, information(self.worlds, i, outcome=None), i)
        return self._observations(), infos

    def step(self, actions: ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Pick and place once in every environment, all at the same time.

        Args:
            actions: (num_envs, 7), see `PickPlaceEnv`

        Raises:
            InputError: an action is not in the action space; nothing has been moved then.
            gymnasium.error.ResetNeeded: there is no episode yet, or one that is over and no
                autoreset.
        """
        if len(self.worlds.episodes) < self.num_envs:
            raise ResetNeeded("no episodes run: call reset() first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self.ended.any():
            over = ", ".join(map(str, np.flatnonzero(self.ended)))
            raise ResetNeeded(f"the episodes of environments {over} are over: reset them")
        rows = real_array(actions, (self.num_envs, 7), name="actions")
        waiting = [int(i) for i in np.flatnonzero(self.ended)]
        acting = {
            i: self.acting.of(action, name=f"action of environment {i}")
            for i, action in enumerate(rows)
            if i not in waiting
        }
        drawn = {i: self.acting.drawn(i, action) for i, action in acting.items()}
        reports = self.worlds.step(drawn) if drawn else {}
        rewards = np.zeros(self.num_envs)
        rewards[list(reports)] = self.rewards.take(list(reports))
        terminations, truncations = np.zeros((2, self.num_envs), bool)
        infos: dict[str, Any] = {}
        for i, report in reports.items():
            info = information(self.worlds, i, outcome=report.outcome)
            info |= self.acting.shift(acting[i], drawn[i])
            terminations[i], truncations[i] = ending(self.worlds, i, info)
            if (
                terminations[i] or truncations[i]
            ) and self.autoreset_mode is AutoresetMode.SAME_STEP:
                waiting.append(i)
                last = {"final_obs": self.observing.of(i), "final_info": info}
                self._add_info(infos, last, i)
            else:
                self._add_info(infos, info, i)
        self.ended = terminations | truncations
        self._start(dict.fromkeys(waiting), {})
        for i in waiting:
            self._add_info(infos, information(self.worlds, i, outcome=None), i)
        ends = (as_backend(part, self.backend) for part in (rewards, terminations, truncations))
        return self._observations(), *ends, infos

    def demonstrate(self, demonstrator: str = "scripted") -> list[Action | None]:
        """What a demonstrator would do now in every environment, as in `PickPlaceEnv`.

        None where the episode is over, and where `PickPlaceEnv` has None.

        Raises:
            InputError: there is no such demonstrator.
            gymnasium.error.ResetNeeded: there is no episode yet.
        """
        if len(self.worlds.episodes) < self.num_envs:
            raise ResetNeeded("no episodes run: call reset() first")
        running = {i: run for i, run in self._runs.items() if not self.ended[i]}
        chosen = find_demonstrator(demonstrator)(self.worlds, running)
        actions = [chosen.get(i) for i in range(self.num_envs)]
        return [self.acting.said(action) if reachable(action) else None for action in actions]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One frame (360, 640, 3) uint8 an environment; None without a render mode."""
        if self.render_mode is None:
            return None
        if len(self.worlds.episodes) < self.num_envs:
            raise ResetNeeded("nothing to draw: call reset() first")
        return tuple(self._view.frame(i) for i in range(self.num_envs))

    def _start(self, seeds: Mapping[int, int | None], goals: Mapping[int, GoalOption]) -> None:
        """Start episodes; a seed of None is drawn from the environment's own generator."""
        if not seeds:
            return
        numbers = {i: self._draw(i) if s is None else s for i, s in seeds.items()}
        made = {i: goal_for(self.task, goal, seed=numbers[i]) for i, goal in goals.items()}
        self.worlds.reset(numbers, goals=made)
        for i, number in numbers.items():
            self._runs[i] = EpisodeRun(number, episode_rng(number, DEMONSTRATOR_STREAM))
            self.ended[i] = False
        self.rewards.start(list(numbers))

    def _draw(self, i: int) -> int:
        rng = self._rngs[i]
        if rng is None:
            rng = self._rngs[i] = seeding.np_random()[0]
        return next_seed(rng)

    def _seeds(self, seed: Seeds) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(
                f"{self.num_envs} environments need {self.num_envs} seeds, got {len(seed)}"
            )
        return [None if s is None else int(s) for s in seed]

    def _masked(self, mask: Any) -> list[int]:
        if mask is None:
            return list(range(self.num_envs))
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise InputError(f"reset_mask must be ({self.num_envs},) bool with one True at least")
        if len(self.worlds.episodes) < self.num_envs:
            raise ResetNeeded("the first reset() is of all environments, without a mask")
        return [int(i) for i in np.flatnonzero(mask)]

    def _observations(self) -> Any:
        seen = [self.observing.of(i) for i in range(self.num_envs)]
        return as_backend(stacked(seen), self.backend)


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(known.value for known in AutoresetMode)
        raise InputError(f"autoreset_mode is one of {known}, not {mode!r}") from error
