"""Where a tip may be led: smooth limits, so that a plan beyond them still has a slope.

A target under the table would press what is held through it: links stretch and guards fire. So a
target is led back before it is sent, by softplus clamps of a stated width, which are nowhere flat
and nowhere steep. They take arrays of NumPy and tensors of torch alike.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..robots.arm import Robot

__all__ = ["TipLimits", "soft_clamp", "soft_floor"]

_TURN = math.radians(70.0)
"""Directions from the base, to either side of the x axis, within which every yaw is in reach."""
_WIND_UP = 3.0
"""A target is remembered so many widths beyond a limit at most, so that it comes back soon."""


def soft_floor(values: Any, floor: Any, width: float) -> Any:
    """`values`, smoothly kept above `floor`: width * log(1 + exp((v - floor) / width)) over it.

    A value on the floor comes to lie 0.69 widths above it, one 5 widths above it stays where it is
    to 1 %.
    """
    library = _library(values)
    return floor + width * library.logaddexp((values - floor) / width, 0 * values)


def soft_clamp(values: Any, low: Any, high: Any, width: float) -> Any:
    """`values`, smoothly kept between two limits, see `soft_floor`."""
    return soft_floor(-soft_floor(-values, -high, width), low, width)


def _before_floor(values: Any, floor: Any, width: float) -> Any:
    """What `soft_floor` gives `values` for, at most `_WIND_UP` widths below the floor."""
    above = np.maximum((values - floor) / width, math.log1p(math.exp(-_WIND_UP)))
    # for a value far above, exp would overflow where nothing is to be undone
    return floor + width * np.where(above > 30.0, above, np.log(np.expm1(np.minimum(above, 30.0))))


def _before_clamp(values: Any, low: Any, high: Any, width: float) -> Any:
    """What `soft_clamp` gives `values` for."""
    return -_before_floor(-_before_floor(values, low, width), -high, width)


@dataclass(frozen=True)
class TipLimits:
    """Smooth limits of a tip: the table, or what is held on it, below; the arm's reach around.

    Attributes:
        robot: whose reach limits the distance from the base, by height
        table: width of the limit to the table [m]
        reach: width of those to the sides and above [m]
        turn: width of the limit to the direction from the base [rad]
    """

    robot: Robot
    table: float = 0.002
    reach: float = 0.01
    turn: float = 0.02

    @functools.cached_property
    def ceiling(self) -> float:
        """Greatest height [m]: 1 cm under the last at which the arm reaches over 20 cm."""
        heights, smallest, largest = self._table()
        return float(heights[largest - smallest >= 0.2].max()) - 0.01

    def project(self, targets: Any, floors: Any) -> Any:
        """Where the tips are led for `targets` (..., 4), x, y, z [m], yaw [rad].

        Args:
            floors: lowest heights of the tips (...), at which what they hold lies on the table [m]
        """
        library = _library(targets)
        x, y, z, yaw = (targets[..., k] for k in range(4))
        z = soft_clamp(z, floors, self.ceiling, self.table)
        near, far = self._radii(z)
        radius = soft_clamp(library.hypot(x, y), near, far, self.reach)
        turn = soft_clamp(library.arctan2(y, x), -_TURN, _TURN, self.turn)
        return library.stack([radius * library.cos(turn), radius * library.sin(turn), z, yaw], -1)

    def asked(self, tips: np.ndarray, floors: np.ndarray) -> np.ndarray:
        """The targets (..., 4) that `project` leads to `tips` (..., 4): its inverse, see `kept`."""
        x, y, z, yaw = (tips[..., k] for k in range(4))
        near, far = self._radii(z)
        radius = _before_clamp(np.hypot(x, y), near, far, self.reach)
        turn = _before_clamp(np.arctan2(y, x), -_TURN, _TURN, self.turn)
        z = _before_clamp(z, floors, self.ceiling, self.table)
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), z, yaw], -1)

    def kept(self, targets: Any, floors: Any) -> Any:
        """Targets (..., 4) as they are remembered: at most three widths beyond a limit.

        A target that is pushed against a limit for long would else take as long to come back.
        """
        library = _library(targets)
        x, y, z, yaw = (targets[..., k] for k in range(4))
        beyond = _WIND_UP * self.table
        # one limit after the other: torch takes no number beside an array
        z = library.clip(library.maximum(z, floors - beyond), None, self.ceiling + beyond)
        near, far = self._radii(library.clip(library.maximum(z, floors), None, self.ceiling))
        beyond = _WIND_UP * self.reach
        wanted = library.hypot(x, y)
        radius = library.clip(wanted, library.clip(near - beyond, 1e-3, None), far + beyond)
        beyond = _WIND_UP * self.turn
        angle = library.arctan2(y, x)
        turn = library.clip(angle, -_TURN - beyond, _TURN + beyond)
        same = (radius == wanted) & (turn == angle)
        if not same.all():  # what is within the limits keeps its bits
            x = library.where(same, x, radius * library.cos(turn))
            y = library.where(same, y, radius * library.sin(turn))
        return library.stack([x, y, z, yaw], -1)

    def remembered(self, start: Any, steps: Any, floors: Any) -> Any:
        """Targets (T, n, 4) after each of `steps` (T, n, 4) from `start` (n, 4), each `kept`.

        Where no limit is met they are sums, and are added up at once, to the same bits.
        """
        library = _library(steps)
        asked = library.concatenate([start[None], steps])
        free = library.cumsum(asked, 0)[1:]
        plain, lowest = (x if library is np else x.detach().numpy() for x in (free, floors))
        if np.array_equal(self.kept(plain, lowest), plain):
            return free
        targets, last = [], start
        for step in steps:
            last = self.kept(last + step, floors)
            targets.append(last)
        return library.stack(targets)

    def _table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.robot.reach_by_height

    @functools.cached_property
    def _tensor_table(self) -> tuple[Any, ...]:
        import torch

        return tuple(torch.from_numpy(np.ascontiguousarray(column)) for column in self._table())

    def _radii(self, z: Any) -> tuple[Any, Any]:
        """Least and greatest distance from the base [m] at heights z, linear in between."""
        heights, smallest, largest = self._table()
        if _library(z) is np:
            return np.interp(z, heights, smallest), np.interp(z, heights, largest)
        import torch

        grid, near, far = (column.to(z) for column in self._tensor_table)
        k = torch.searchsorted(grid, z.detach().contiguous()).clamp(1, len(heights) - 1)
        u = (z - grid[k - 1]) / (grid[k] - grid[k - 1])
        return near[k - 1] + u * (near[k] - near[k - 1]), far[k - 1] + u * (far[k] - far[k - 1])


def _library(values: Any) -> Any:
    """NumPy or torch: whose these are."""
    if isinstance(values, np.ndarray | float | int | np.generic):
        return np
    import torch

    return torch
