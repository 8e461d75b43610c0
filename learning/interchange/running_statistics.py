"""Minimum, maximum, mean, deviation and quantiles of a column that is too large to hold."""

from __future__ import annotations

import numpy as np

__all__ = ["QUANTILES", "RunningStatistics"]

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""What LeRobot calls them."""
_LEVELS = 256
"""Of a picture's channel: its values are k / 255."""


class RunningStatistics:
    """Statistics over rows that come in batches, as LeRobot lists them.

    Args:
        shape: of a mean; its components are the rows' columns. Three numbers deep it is that of a
            picture's channels
        quantiles: whether these are told, too; they are exact. Rows of pictures are counted by
            their levels, other rows are kept as float32

    Source: Chan, Golub and LeVeque, "Algorithms for computing the sample variance", 1983.
    """

    def __init__(self, shape: tuple[int, ...], *, quantiles: bool = False) -> None:
        self._shape, self._quantiles = shape, quantiles
        self._counts = np.zeros((shape[0], _LEVELS), np.int64) if len(shape) == 3 else None
        self._kept: list[np.ndarray] = []
        self._rows = self._frames = 0
        self._mean = self._squares = np.zeros(0)
        self._low = self._high = np.zeros(0)

    def add(self, rows: np.ndarray, *, frames: int) -> None:
        """Add rows (n, components), n >= 1; they are of so many frames."""
        if self._quantiles:
            self._keep(rows)
        rows = rows.astype(float)
        low, high = rows.min(axis=0), rows.max(axis=0)
        mean = rows.mean(axis=0)
        squares = ((rows - mean) ** 2).sum(axis=0)
        if self._rows:
            low, high = np.minimum(low, self._low), np.maximum(high, self._high)
            n, m = self._rows, len(rows)
            difference = mean - self._mean
            squares = squares + self._squares + difference**2 * n * m / (n + m)
            mean = self._mean + difference * m / (n + m)
        self._low, self._high, self._mean, self._squares = low, high, mean, squares
        self._rows += len(rows)
        self._frames += frames

    def as_lists(self) -> dict[str, list[object]]:
        """min, max, mean, std and quantiles in the given shape, and count: how many frames."""
        values = {
            "min": self._low,
            "max": self._high,
            "mean": self._mean,
            "std": np.sqrt(self._squares / self._rows),
        }
        if self._quantiles:
            values |= {name: self._quantile(share) for name, share in QUANTILES.items()}
        lists = {name: value.reshape(self._shape).tolist() for name, value in values.items()}
        return {**lists, "count": [self._frames]}

    def _keep(self, rows: np.ndarray) -> None:
        if self._counts is None:
            self._kept.append(rows.astype(np.float32))
            return
        levels = np.rint(rows * (_LEVELS - 1)).astype(np.int64)
        for channel, counts in enumerate(self._counts):
            counts += np.bincount(levels[:, channel], minlength=_LEVELS)

    def _quantile(self, share: float) -> np.ndarray:
        """Values (components,) that a share of the rows does not exceed."""
        if self._counts is None:
            if len(self._kept) > 1:
                self._kept = [np.concatenate(self._kept)]
            return np.asarray(np.quantile(self._kept[0], share, axis=0))
        reached = self._counts.cumsum(axis=1) >= share * self._rows
        return np.asarray(reached.argmax(axis=1) / (_LEVELS - 1))
