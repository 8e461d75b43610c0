"""Adam along gradients whose length does not count, for actions and waypoints alike.

Source: Kingma, Ba, "Adam", 2015.
"""

from __future__ import annotations

import numpy as np

__all__ = ["Descent"]

_FIRST, _SECOND = 0.8, 0.9


class Descent:
    """Steps (n, d) downhill for n points at once; a step k is as long as `scale` / sqrt(k).

    Every gradient is scaled to length 1 first: those of chaotic rollouts have spikes, so that only
    directions are to be trusted.

    Args:
        scale: (d,), lengths of the first step
    """

    def __init__(self, shape: tuple[int, int], scale: np.ndarray) -> None:
        self._first, self._second = np.zeros(shape), np.zeros(shape)
        self._scale, self._count = np.asarray(scale, dtype=float), 0

    def step(self, gradients: np.ndarray) -> np.ndarray:
        """How to move (n, d), given the gradients (n, d) of where the points are."""
        self._count = k = self._count + 1
        norms = np.linalg.norm(gradients, axis=1, keepdims=True)
        gradients = gradients / np.maximum(norms, 1e-12)
        self._first = _FIRST * self._first + (1 - _FIRST) * gradients
        self._second = _SECOND * self._second + (1 - _SECOND) * gradients**2
        mean = self._first / (1 - _FIRST**k)
        spread = np.sqrt(self._second / (1 - _SECOND**k))
        return np.asarray(-self._scale / np.sqrt(k) * mean / (spread + 1e-8))
