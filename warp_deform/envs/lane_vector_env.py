"""What vector environments in one simulator share: seeds, resets by themselves, backends, names."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Space
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ..errors import InputError
from ..support.checked import real_array
from ..tasks.task import Task
from ..worlds.worlds import Worlds
from .backends import Backend, as_backend, check_backend, stacked
from .named_calls import NamedCalls
from .reset_options import IGNORED, GoalOption, check_options, next_seed
from .worlds_view import WorldsView, check_render_mode

__all__ = ["LaneVectorEnv", "Stepped"]

Seeds = int | Sequence[int | None] | None


@dataclass(frozen=True)
class Stepped:
    """What a step did to one environment."""

    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class LaneVectorEnv(NamedCalls, VectorEnv[Any, Any, Any], abc.ABC):
    """Episodes side by side in the lanes of one simulator; a subclass says what a step is.

    Args:
        worlds: a slot an environment
        observation: space of one environment
        action: space of one environment, a Box of one dimension
        autoreset_mode: see `PickPlaceVectorEnv`, as are the other arguments
        arm_follows: see `WorldsView`
    """

    def __init__(
        self,
        worlds: Worlds,
        *,
        observation: Space[Any],
        action: Space[Any],
        render_mode: str | None,
        autoreset_mode: AutoresetMode | str,
        backend: Backend,
        arm_follows: bool = False,
    ) -> None:
        self.render_mode = check_render_mode(render_mode, self.metadata)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs = worlds.count
        self.worlds = worlds
        self.backend = check_backend(backend)
        self.single_observation_space = observation
        self.single_action_space = action
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.ended = np.zeros(self.num_envs, bool)
        """(num_envs,) bool: which episodes are over and wait for their reset."""
        self._rngs: list[np.random.Generator | None] = [None] * self.num_envs
        self._view = WorldsView(self.worlds, arm_follows=arm_follows)

    @property
    def task(self) -> Task:
        """The task that is played."""
        return self.worlds.task

    @property
    def task_description(self) -> str:
        """See `PickPlaceEnv`."""
        return self.task.instruction

    # -- what a subclass says

    @abc.abstractmethod
    def _begin(self, seeds: Mapping[int, int], goals: Mapping[int, GoalOption]) -> None:
        """Start the episodes with these seeds; goals where some were given."""

    @abc.abstractmethod
    def _checked(self, i: int, action: np.ndarray) -> np.ndarray:
        """The action of environment i; InputError where it is not in the space."""

    @abc.abstractmethod
    def _act(self, actions: Mapping[int, np.ndarray]) -> Mapping[int, Stepped]:
        """Run a step in these environments."""

    @abc.abstractmethod
    def _see(self, i: int) -> Any:
        """What is seen of an environment."""

    @abc.abstractmethod
    def _tell(self, i: int) -> dict[str, Any]:
        """The info of an environment that has just been reset."""

    # -- Gymnasium

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
            self._add_info(infos, self._tell(i), i)
        return self._observations(), infos

    def step(self, actions: ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Run a step in every environment, all at the same time.

        Args:
            actions: one a row, see `single_action_space`

        Raises:
            InputError: an action is not in the action space; nothing has been moved then.
            gymnasium.error.ResetNeeded: there is no episode yet, or one that is over and no
                autoreset.
        """
        self._check_begun("no episodes run: call reset() first")
        if self.autoreset_mode is AutoresetMode.DISABLED and self.ended.any():
            over = ", ".join(map(str, np.flatnonzero(self.ended)))
            raise ResetNeeded(f"the episodes of environments {over} are over: reset them")
        shape = self.action_space.shape
        assert shape is not None, "a Box has one"
        rows = real_array(actions, shape, name="actions")
        waiting = [int(i) for i in np.flatnonzero(self.ended)]
        acting = {i: self._checked(i, row) for i, row in enumerate(rows) if i not in waiting}
        rewards = np.zeros(self.num_envs)
        terminations, truncations = np.zeros((2, self.num_envs), bool)
        infos: dict[str, Any] = {}
        for i, done in (self._act(acting) if acting else {}).items():
            rewards[i], terminations[i], truncations[i] = (
                done.reward, done.terminated, done.truncated
            )  # fmt: skip
            if (
                terminations[i] or truncations[i]
            ) and self.autoreset_mode is AutoresetMode.SAME_STEP:
                waiting.append(i)
                last = {"final_obs": self._see(i), "final_info": done.info}
                self._add_info(infos, last, i)
            else:
                self._add_info(infos, done.info, i)
        self.ended = terminations | truncations
        self._start(dict.fromkeys(waiting), {})
        for i in waiting:
            self._add_info(infos, self._tell(i), i)
        ends = (as_backend(part, self.backend) for part in (rewards, terminations, truncations))
        return self._observations(), *ends, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One frame (360, 640, 3) uint8 an environment; None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_begun("nothing to draw: call reset() first")
        return tuple(self._view.frame(i) for i in range(self.num_envs))

    def _check_begun(self, otherwise: str) -> None:
        if len(self.worlds.episodes) < self.num_envs:
            raise ResetNeeded(otherwise)

    def _start(self, seeds: Mapping[int, int | None], goals: Mapping[int, GoalOption]) -> None:
        """Start episodes; a seed of None is drawn from the environment's own generator."""
        if not seeds:
            return
        numbers = {i: self._draw(i) if s is None else s for i, s in seeds.items()}
        self._begin(numbers, goals)
        self.ended[list(numbers)] = False

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
        seen = [self._see(i) for i in range(self.num_envs)]
        return as_backend(stacked(seen), self.backend)


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        known = ", ".join(known.value for known in AutoresetMode)
        raise InputError(f"autoreset_mode is one of {known}, not {mode!r}") from error
