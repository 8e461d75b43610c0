"""Limits of difference quotients as their step goes to 0, and how well they are known.

Richardson's extrapolation over a ladder of steps; the entry is taken that agrees best with its
neighbours. Source: Ridders, "Accurate computation of F'(x) and F'(x) F''(x)", Advances in
Engineering Software 4(2), 1982.
"""

from __future__ import annotations

import numpy as np

__all__ = ["RATIO", "central", "kink"]

RATIO = 4.0
"""Of each step to the next smaller one."""


def central(changes: np.ndarray, steps: np.ndarray, rounding: float) -> tuple[float, float]:
    """The derivative, and a bound of its error that knows of no derivative computed otherwise.

    Args:
        changes: f(x + h) - f(x - h) at the steps h, from the largest to the smallest
        rounding: what the arithmetic leaves of values of f
    """
    return _limit(changes / (2 * steps), rounding / steps, power=2)


def kink(second: np.ndarray, steps: np.ndarray, rounding: float) -> tuple[float, float]:
    """By how much the one-sided derivatives at x differ, and a bound of its error.

    Args:
        second: f(x + h) - 2 f(x) + f(x - h) at the steps h
    """
    return _limit(second / steps, 2 * rounding / steps, power=1)


def _limit(values: np.ndarray, noise: np.ndarray, *, power: int) -> tuple[float, float]:
    """Of values whose errors go as the step's `power`, `2 power` and so on.

    Steps above one where the values jump, by far more than that, are left out: they lead across a
    branch to where the values agree with each other again.
    """
    first, usual = len(values) - 1, 0.0
    while first > 0:
        away = abs(values[first - 1] - values[first])
        if usual and away > 4 * RATIO**power * usual:
            break
        first -= 1
        usual = max(away, noise[first])
    values, noise = values[first:], noise[first:]
    best, bound = float(values[-1]), np.inf
    column = values
    for order in range(1, len(values)):
        factor = RATIO ** (power * order)
        better = (factor * column[1:] - column[:-1]) / (factor - 1)
        for k, value in enumerate(better):
            # of both entries that it comes from: one alone may agree by chance
            away = max(abs(value - column[k]), abs(value - column[k + 1]))
            for entry, error in ((value, noise[k + order]), (column[k], noise[k + order - 1])):
                if max(away, error) < bound:
                    best, bound = float(entry), float(max(away, error))
        column = better
    return best, bound
