"""Poses as the interface writes them, sixteen numbers by columns: valid, apart, moved on."""

from __future__ import annotations

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
    if not np.isfinite(columns).all():
        return False
    T = np.asarray(columns).reshape(4, 4).T
    if np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > ORTHONORMAL:
        return False
    R = T[:3, :3]
    if np.abs(R).max() > 2.0 or np.abs(T[:3, 3]).max() > FARTHEST:
        return False
    return bool(np.abs(R.T @ R - np.eye(3)).max() <= ORTHONORMAL and np.linalg.det(R) > 0.0)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return translation [m] and rotation vector [rad] from pose a to b, (4, 4) each, shape (6,).

    Both in the frame of the poses. The rotation is below a quarter turn.
    """
    R = b[:3, :3] @ a[:3, :3].T
    turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt(turn @ turn))
    if sine > 1e-6:  # below, a sine is its angle to the last bit
        turn *= np.arcsin(min(sine, 1.0)) / sine
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
