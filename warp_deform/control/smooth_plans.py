"""Plans of a tip that change smoothly: a few numbers each, drawn at random or searched over."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["KNOTS", "actions_of", "numbers_of", "smooth_plan", "tensor_actions_of"]

KNOTS = 6
"""Points in time at which a plan's numbers are free; in between they are interpolated."""


def actions_of(knots: np.ndarray, steps: int) -> np.ndarray:
    """Actions (..., T, 3), each of a length below 1, of free numbers `knots` (..., K, 3).

    Numbers are linear in time between the knots; u becomes u / sqrt(1 + |u|^2).
    """
    numbers = numbers_of(knots, steps)
    return np.asarray(numbers / np.sqrt(1 + (numbers**2).sum(axis=-1, keepdims=True)))


def numbers_of(knots: np.ndarray, steps: int) -> np.ndarray:
    """Numbers (..., T, 3), those of every step, of free numbers (..., K, 3)."""
    return np.asarray(_spread(knots.shape[-2], steps) @ knots)


def tensor_actions_of(knots: Tensor, steps: int) -> Tensor:
    """Actions (..., T, 3) of free numbers (..., K, 3), as `actions_of`, of tensors in torch."""
    numbers = knots.new_tensor(_spread(knots.shape[-2], steps)) @ knots
    return numbers / (1 + (numbers**2).sum(dim=-1, keepdim=True)).sqrt()


def smooth_plan(rng: np.random.Generator, steps: int, spread: float = 1.5) -> np.ndarray:
    """A plan (T, 3) at random; `spread` is the standard deviation of its free numbers."""
    return actions_of(rng.normal(0.0, spread, (KNOTS, 3)), steps)


@functools.cache
def _spread(knots: int, steps: int) -> np.ndarray:
    """(T, K): shares of the knots in every step."""
    at = np.linspace(0, knots - 1, steps)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
