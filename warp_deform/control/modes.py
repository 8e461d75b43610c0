"""Control modes: what the numbers of an action at a fixed rate mean to the tip.

Every mode has numbers from -1 to 1, of which the last is `hold`: above 0 the tip takes the nearest
thing under it and keeps it, otherwise it lets go. (robosuite closes at +1 as well, ManiSkill opens
at +1.) Delta modes add to the last target, not to where the tip is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..errors import InputError
from ..rendering.pixels import BOUNDS
from ..support.checked import POSITIVE, check_fields
from .limits import TipLimits

__all__ = ["ControlMode", "TipTargets"]  # `warp_deform.control` has the others

ControlMode = Literal["tip_delta_position", "tip_delta_pose", "tip_velocity", "tip_position"]
CONTROL_MODES: dict[str, tuple[str, ...]] = {
    "tip_delta_position": ("dx", "dy", "dz", "hold"),
    "tip_delta_pose": ("dx", "dy", "dz", "dyaw", "hold"),
    "tip_velocity": ("vx", "vy", "vz", "yaw rate", "hold"),
    "tip_position": ("x", "y", "z", "yaw", "hold"),
}
"""What the numbers of an action are called, by mode.

In others' words these are `pd_ee_target_delta_pos`, `pd_ee_target_delta_pose`, a Cartesian velocity
and an absolute pose.
"""
_KNOTS = 4
"""Knots a step of a tip that changes its velocity evenly."""
_HEIGHTS = (0.0, 0.40)
"""Range of the heights that `tip_position` has from -1 to 1 [m]."""


@dataclass(frozen=True, kw_only=True)
class ControlConfig:
    """How fast tips are led.

    Attributes:
        rate: control steps a second [Hz], each of a whole number of substeps
        max_speed: of a tip whose action has length 1 [m/s]; a longer action goes no faster. A UR5
            does about 1 m/s, a Panda 1.7
        max_turn: speed of its turn by an action of 1 [rad/s]
    """

    rate: float = 20.0
    max_speed: float = 1.0
    max_turn: float = 2.0

    def __post_init__(self) -> None:
        check_fields(self, dict.fromkeys(("rate", "max_speed", "max_turn"), POSITIVE))

    @property
    def seconds(self) -> float:
        """Length of a control step [s]."""
        return 1.0 / self.rate


class TipTargets:
    """The targets of W tips: actions in, knots of the tips' paths out.

    A target is remembered as it was asked for, and projected (see `TipLimits`) whenever it is sent,
    so a tip that is told nothing waits where it is, also at a limit.

    Raises:
        InputError: there is no such mode.
    """

    def __init__(self, mode: str, config: ControlConfig, limits: TipLimits, count: int) -> None:
        if mode not in get_args(ControlMode):
            known = ", ".join(CONTROL_MODES)
            raise InputError(f"control_mode is one of {known}, not {mode!r}")
        self.mode, self.config, self.limits = mode, config, limits
        self.asked = np.zeros((count, 4))
        """Last targets (W, 4), x, y, z [m], yaw [rad], before they are projected."""
        self.velocities = np.zeros((count, 4))
        """With which the tips arrived there (W, 4) [m/s, rad/s]; only "tip_velocity" keeps them."""
        self.floors = np.zeros(count)
        """Lowest heights of the tips (W,) [m], see `TipLimits.project`."""

    @property
    def width(self) -> int:
        """How many numbers an action has."""
        return len(CONTROL_MODES[self.mode])

    def place(self, rows: Sequence[int], tips: np.ndarray) -> None:
        """Note that tips stand still at `tips` (n, 4)."""
        self.asked[list(rows)] = tips
        self.velocities[list(rows)] = 0.0

    def sent(self, rows: Sequence[int]) -> np.ndarray:
        """Where the tips are told to be now (n, 4)."""
        at = list(rows)
        return np.asarray(self.limits.project(self.asked[at], self.floors[at]))

    def follow(self, rows: Sequence[int], actions: np.ndarray) -> np.ndarray:
        """Knots (n, K, 4) of the tips' paths in the next control step, for actions (n, width)."""
        at = list(rows)
        moves, floors = np.asarray(actions, dtype=float)[:, :-1], self.floors[at]
        if self.mode == "tip_velocity":
            return self._by_velocity(at, self._velocity(moves))
        if self.mode == "tip_position":
            step = self._towards(at, moves)
        else:
            step = self._velocity(moves) * self.config.seconds
        self.asked[at] = self.limits.kept(self.asked[at] + step, floors)
        return np.asarray(self.limits.project(self.asked[at], floors))[:, None]

    def follow_steps(self, rows: Sequence[int], actions: np.ndarray) -> np.ndarray:
        """Targets (T, n, 4) of `follow` in T control steps, for actions (T, n, width), at once.

        Only for modes that add to the last target.
        """
        assert self.mode.startswith("tip_delta"), self.mode
        at, moves = list(rows), np.asarray(actions, dtype=float)[..., :-1]
        steps = self._velocity(moves.reshape(-1, moves.shape[-1])) * self.config.seconds
        floors = self.floors[at]
        asked = self.limits.remembered(self.asked[at], steps.reshape(*moves.shape[:2], 4), floors)
        self.asked[at] = asked[-1]
        return np.asarray(self.limits.project(asked, floors))

    def _velocity(self, moves: np.ndarray) -> np.ndarray:
        """Speeds (n, 4) [m/s, rad/s] of actions (n, 3 or 4)."""
        length = np.linalg.norm(moves[:, :3], axis=1, keepdims=True)
        speeds = self.config.max_speed * moves[:, :3] / np.maximum(length, 1.0)
        turns = self.config.max_turn * moves[:, 3:] if moves.shape[1] > 3 else 0 * moves[:, :1]
        return np.concatenate([speeds, turns], axis=1)

    def _towards(self, at: list[int], moves: np.ndarray) -> np.ndarray:
        """The step (n, 4) towards poses (n, 4) on the workspace, as far as the speed allows."""
        (x0, x1), (y0, y1), (z0, z1) = (*BOUNDS[:2], _HEIGHTS)
        low, high = np.array([x0, y0, z0, -np.pi]), np.array([x1, y1, z1, np.pi])
        way = low + (moves + 1) / 2 * (high - low) - self.asked[at]
        far = self.config.max_speed * self.config.seconds
        length = np.linalg.norm(way[:, :3], axis=1, keepdims=True)
        turn = self.config.max_turn * self.config.seconds
        return np.concatenate(
            [way[:, :3] * np.minimum(1.0, far / np.maximum(length, 1e-12)),
             np.clip(way[:, 3:], -turn, turn)],
            axis=1,
        )  # fmt: skip

    def _by_velocity(self, at: list[int], wanted: np.ndarray) -> np.ndarray:
        """Knots of a step in which speeds change evenly to the wanted ones, without a jerk."""
        seconds, floors = self.config.seconds, self.floors[at]
        before, start = self.velocities[at], self.asked[at]
        knots = []
        for k in range(1, _KNOTS + 1):
            u = k / _KNOTS
            way = seconds * (u * before + u * u / 2 * (wanted - before))
            knots.append(self.limits.kept(start + way, floors))
        self.asked[at], self.velocities[at] = knots[-1], wanted
        projected = [self.limits.project(knot, floors) for knot in knots]
        return np.stack(projected, axis=1)
