"""Poses as sixteen numbers by columns, as the interface sends them: checks and differences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

__all__ = ["difference", "is_frame", "moved_on"]

# How far a frame's columns may be from unit length and right angles, as libfranka has it.
ORTHONORMAL = 1e-5
# No end effector is farther from its flange, no pose farther from the base [m].
FARTHEST = 10.0


def is_frame(columns: np.ndarray) -> bool:
    """Return whether sixteen numbers, column by column, are a pose [m]; NaN and inf never are.

    Source: `franka::isHomogeneousTransformation`, and right angles between the columns.
    """
    numbers = columns.tolist()  # once a millisecond: floats are faster than short arrays
    x, y, z, p = (numbers[4 * i : 4 * i + 3] for i in range(4))
    products = (_dot(x, x) - 1, _dot(y, y) - 1, _dot(z, z) - 1, _dot(x, y), _dot(y, z), _dot(z, x))
    last_row = (numbers[3], numbers[7], numbers[11], numbers[15] - 1.0)
    # A comparison with NaN is false.
    if not all(abs(number) <= ORTHONORMAL for number in (*products, *last_row)):
        return False
    across = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    return _dot(across, z) > 0.0 and all(abs(number) <= FARTHEST for number in p)


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return translation [m] and rotation vector [rad] from pose a to b, (4, 4) each, shape (6,).

    Both in the frame of the poses. About which axis half a turn goes is not said.
    """
    R = b[:3, :3] @ a[:3, :3].T
    turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = math.sqrt(turn @ turn), 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    if sine > 1e-6:  # below, a sine is its angle to the last bit
        turn *= math.atan2(sine, cosine) / sine
    elif cosine < 0.0:
        turn = np.array([np.pi, 0.0, 0.0])
    return np.concatenate([b[:3, 3] - a[:3, 3], turn])


def moved_on(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return pose T (4, 4) after a step (6,) of translation [m] and rotation vector [rad]."""
    angle = float(np.linalg.norm(step[3:]))
    W = np.zeros((3, 3))
    if angle > 0.0:
        x, y, z = step[3:] / angle
        W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    moved = T.copy()
    # Rodrigues' formula.
    moved[:3, :3] = (np.eye(3) + np.sin(angle) * W + (1.0 - np.cos(angle)) * W @ W) @ T[:3, :3]
    moved[:3, 3] += step[:3]
    return moved
