"""Ways to show a running episode: pictures, numbers, or both, as an agent's library expects them.

Pictures by the names that LeRobot reads: `pixels` holds cameras (H, W, 3) uint8, `agent_pos` is
what a robot knows of itself, `environment_state` what a camera does not tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol, get_args

import numpy as np
from gymnasium import spaces

from ..episodes import MAX_HEIGHT
from ..errors import InputError
from ..rendering.pixels import SHAPE
from ..tasks.free_space import FreeSpace
from .spaces import observation, observation_space
from .worlds import Worlds

__all__ = ["Numbers", "ObsMode", "Observing", "PickPlaceNumbers"]

ObsMode = Literal["images", "state", "state_dict", "rgb", "rgbd", "rgb+state"]


class Numbers(Protocol):
    """What "state_dict" holds of a slot."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Of every entry, in the order of "state"; what has no numbers is left out."""

    @property
    def agent(self) -> tuple[str, ...]:
        """Entries that a robot knows of itself: `agent_pos`."""

    def of(self, slot: int) -> Mapping[str, np.ndarray]:
        """The entries of a slot, as they are."""


class PickPlaceNumbers:
    """Where tip, particles and bodies are between two actions."""

    agent: tuple[str, ...] = ("tip",)

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds
        world = worlds.solver.data.topologies[0]
        self.shapes: Mapping[str, tuple[int, ...]] = {
            "tip": (4,),
            "particle_q": (world.particle_count, 3),
            "body_q": (world.body_count, 7),
            "goal": goal_shape(worlds),
            "time": (1,),
        }

    def of(self, slot: int) -> Mapping[str, np.ndarray]:
        """The entries of a slot."""
        episode = self._worlds.episodes[slot]
        return {
            "tip": episode.tip,
            "particle_q": episode.snapshot.particle_q,
            "body_q": episode.snapshot.body_q,
            "goal": episode.layout.targets,
            "time": np.array([len(episode.history) / self._worlds.task.max_actions]),
        }


def goal_shape(worlds: Worlds) -> tuple[int, ...]:
    """Shape of what the task aims at."""
    return worlds.task.sample(np.random.default_rng(0), FreeSpace()).targets.shape


class Observing:
    """The observations of one mode; `of` makes a slot's, new arrays that the caller may change.

    - "images": `color`, `height`, with a goal also `goal_color`, `goal_height`;
    - "state": the numbers of "state_dict" in its order, (D,) float32;
    - "state_dict": `tip` x, y, z [m], yaw [rad], `particle_q` (P, 3) [m], `body_q` (B, 7), `goal`
      (what the task aims at, `Layout.targets`), `time` (share of the actions that are used up);
    - "rgb": `pixels` {`top`, with a goal also `goal`: (320, 160, 3) uint8}, `agent_pos` (the tip);
    - "rgbd": the same and `depth`, height above the table (320, 160) float32 [m];
    - "rgb+state": that of "rgb" and `environment_state`, which is that of "state".

    Where `numbers` says so, "state_dict" and `agent_pos` hold other entries. What a task has none
    of, particles or bodies, is left out. All is zero where a state is not finite; its `physics_ok`
    is False then.

    Raises:
        InputError: there is no such mode.
    """

    def __init__(self, worlds: Worlds, mode: str, numbers: Numbers | None = None) -> None:
        if mode not in get_args(ObsMode):
            raise InputError(f"obs_mode is one of {', '.join(get_args(ObsMode))}, not {mode!r}")
        self._worlds, self.mode = worlds, mode
        self._numbers = numbers or PickPlaceNumbers(worlds)
        self.space: spaces.Space[Any] = self._space()

    def of(self, slot: int) -> Any:
        """What an agent sees of a slot."""
        if self.mode == "images":
            return observation(self._worlds, slot)
        if self.mode == "state":
            return self._flat(slot)
        if self.mode == "state_dict":
            return self._state(slot)
        pictures = observation(self._worlds, slot)
        pixels = {"top": pictures["color"]}
        if "goal_color" in pictures:
            pixels["goal"] = pictures["goal_color"]
        seen: dict[str, Any] = {"pixels": pixels, "agent_pos": self._agent(slot)}
        if self.mode == "rgbd":
            seen["depth"] = pictures["height"]
        if self.mode == "rgb+state":
            seen["environment_state"] = self._flat(slot)
        return seen

    def _state(self, slot: int) -> dict[str, np.ndarray]:
        numbers = self._numbers.of(slot)
        state = {name: np.array(array, np.float32) for name, array in numbers.items() if array.size}
        if all(np.isfinite(array).all() for array in state.values()):
            return state
        return {name: np.zeros_like(array) for name, array in state.items()}

    def _agent(self, slot: int) -> np.ndarray:
        state = self._state(slot)
        return np.concatenate([state[name] for name in self._numbers.agent])

    def _flat(self, slot: int) -> np.ndarray:
        return np.concatenate([array.ravel() for array in self._state(slot).values()])

    def _space(self) -> spaces.Space[Any]:
        if self.mode == "images":
            return observation_space(self._worlds.task)
        shapes = self._numbers.shapes
        boxes: dict[str, spaces.Space[Any]] = {
            name: _numbers(shape) for name, shape in shapes.items() if np.prod(shape)
        }
        if self.mode == "state_dict":
            return spaces.Dict(boxes)
        size = sum(int(np.prod(shape)) for name, shape in shapes.items() if name in boxes)
        if self.mode == "state":
            return _numbers((size,))
        agent = sum(int(np.prod(shapes[name])) for name in self._numbers.agent)
        picture = spaces.Box(0, 255, (*SHAPE, 3), np.uint8)
        pixels: dict[str, spaces.Space[Any]] = {"top": picture}
        if self._worlds.task.goal_conditioned:
            pixels["goal"] = picture
        seen: dict[str, Any] = {"pixels": spaces.Dict(pixels), "agent_pos": _numbers((agent,))}
        if self.mode == "rgbd":
            seen["depth"] = spaces.Box(0.0, MAX_HEIGHT, SHAPE, np.float32)
        if self.mode == "rgb+state":
            seen["environment_state"] = _numbers((size,))
        return spaces.Dict(seen)


def _numbers(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)
