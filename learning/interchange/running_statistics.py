"""Minimum, maximum, mean and standard deviation of a column that is too large to hold."""

from __future__ import annotations

import numpy as np

__all__ = ["RunningStatistics"]


class RunningStatistics:
    """Statistics over rows that come in batches, as LeRobot lists them.

    Args:
        shape: of a mean; its components are the rows' columns

    Source: Chan, Golub and LeVeque, "Algorithms for computing the sample variance", 1983.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._rows = self._frames = 0
        self._mean = self._squares = np.zeros(0)
        self._low = self._high = np.zeros(0)

    def add(self, rows: np.ndarray, *, frames: int) -> None:
        """Add rows (n, components), n >= 1; they are of so many frames."""
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
        """min, max, mean and std in the given shape, and count: how many frames."""
        values = {
            "min": self._low,
            "max": self._high,
            "mean": self._mean,
            "std": np.sqrt(self._squares / self._rows),
        }
        lists = {name: value.reshape(self._shape).tolist() for name, value in values.items()}
        return {**lists, "count": [self._frames]}
