"""Plans of a tip that change smoothly: a few numbers each, drawn at random or searched over."""

from __future__ import annotations

import functools

import numpy as np

__all__ = ["KNOTS", "actions_of", "smooth_plan"]

KNOTS = 6
"""Points in time at which a plan's numbers are free; in between they are interpolated."""


def actions_of(knots: np.ndarray, steps: int) -> np.ndarray:
    """Actions (..., T, 3), each of a length below 1, of free numbers `knots` (..., K, 3).

    Numbers are linear in time between the knots; u becomes u / sqrt(1 + |u|^2).
    """
    numbers = _spread(knots.shape[-2], steps) @ knots
    return np.asarray(numbers / np.sqrt(1 + (numbers**2).sum(axis=-1, keepdims=True)))


def smooth_plan(rng: np.random.Generator, steps: int, spread: float = 1.5) -> np.ndarray:
    """A plan (T, 3) at random; `spread` is the standard deviation of its free numbers."""
    return actions_of(rng.normal(0.0, spread, (KNOTS, 3)), steps)


@functools.cache
def _spread(knots: int, steps: int) -> np.ndarray:
    """(T, K): shares of the knots in every step."""
    at = np.linspace(0, knots - 1, steps)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
