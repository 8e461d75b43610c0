"""What episodes of control at a fixed rate hold beyond those of picks and places."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError

CONTROL = "control"
"""Where an episode's `extra` keeps its `ControlRecord`."""
_MOST_TARGETS = 100_000


@dataclass(frozen=True, eq=False)
class ControlRow:
    """What a row of control at a fixed rate has beyond the others."""

    tip: np.ndarray
    """Where the tip is: x, y, z [m], yaw [rad], (4,) float64."""
    holding: bool
    """Whether the tip holds something."""
    reward: float
    """Of the control step that has led here; 0 in the first row."""


@dataclass(frozen=True, kw_only=True)
class ControlRecord:
    """How the tip of an episode was led: the options of `ControlEnv` that repeat it, and the goal.

    Attributes:
        names: of the numbers of an action, each of which is from -1 to 1
        mode: `control_mode` of the environment, `start` and `release` are its options
        rate: control steps a second [Hz]
        max_speed: of the tip [m/s]
        max_turn: of its turn [rad/s]
        horizon: control steps after which an episode is cut off
        reward_mode: of the environment
        instruction: what is to be done, as a sentence
        targets: what the task aims at, flat; `shape` says how it was
        pictures: whether rows have them
    """

    names: tuple[str, ...]
    mode: str
    start: str
    release: str
    rate: float
    max_speed: float
    max_turn: float
    horizon: int
    reward_mode: str
    instruction: str
    targets: tuple[float, ...]
    shape: tuple[int, ...]
    pictures: bool

    def as_json(self) -> dict[str, Any]:
        """JSON types."""
        record = dataclasses.asdict(self)
        return record | {name: list(record[name]) for name in ("names", "targets", "shape")}

    @property
    def goal(self) -> np.ndarray:
        """What the task aims at, in its own shape."""
        return np.array(self.targets, dtype=float).reshape(self.shape)

    @staticmethod
    def of(extra: dict[str, Any]) -> ControlRecord:
        """The record in an episode's `extra`.

        Raises:
            InputError: it is not there, or not whole.
        """
        record = extra.get(CONTROL)
        kinds: dict[str, type | tuple[type, ...]] = {
            "names": list, "mode": str, "start": str, "release": str, "rate": (int, float),
            "max_speed": (int, float), "max_turn": (int, float), "horizon": int,
            "reward_mode": str, "instruction": str, "targets": list, "shape": list,
            "pictures": bool,
        }  # fmt: skip
        if not isinstance(record, dict) or record.keys() != kinds.keys():
            raise InputError("its metadata does not say how the tip was led")
        for name, kind in kinds.items():
            value = record[name]
            if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
                raise InputError(f"its metadata has control.{name} {str(value)[:80]!r}")
        numbers = [record[name] for name in ("rate", "max_speed", "max_turn")]
        if not all(math.isfinite(number) and number > 0 for number in numbers):
            raise InputError("its metadata has a rate or a speed that is not above 0")
        if not all(isinstance(name, str) for name in record["names"]) or not record["names"]:
            raise InputError("its metadata does not name the numbers of an action")
        if not all(type(x) in (int, float) and math.isfinite(x) for x in record["targets"]):
            raise InputError("its metadata has targets that are not finite numbers")
        whole = all(type(n) is int and 0 <= n <= _MOST_TARGETS for n in record["shape"])
        if not whole or math.prod(record["shape"]) != len(record["targets"]):
            raise InputError("its metadata has targets of another shape than it says")
        lists = {name: tuple(record[name]) for name in ("names", "targets", "shape")}
        return ControlRecord(**{**record, **lists})
