"""State vectors of the paper's ground-truth baselines.

Source: Seita et al., ICRA 2021, section on baselines: a rigid body is (x, y, -yaw / 15), because
the policies count rotations in steps of 15 degrees.
"""

from __future__ import annotations

import numpy as np

__all__ = ["YAW_SCALE", "pose_rows", "quaternion_yaw"]

YAW_SCALE = 15.0


def pose_rows(xy: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
    """Rows (n, 3) float32 of x, y [m] and -yaw / 15 [rad] from `xy` (n, 2 or 3) and `yaw` (n,)."""
    xy = np.atleast_2d(np.asarray(xy, dtype=float))[:, :2]
    return np.column_stack([xy, np.broadcast_to(-np.asarray(yaw) / YAW_SCALE, len(xy))]).astype(
        np.float32
    )


def quaternion_yaw(quat_xyzw: np.ndarray) -> float:
    """Turn about the vertical axis [rad, -pi to pi] of a rotation given as quat_xyzw (4,).

    >>> round(quaternion_yaw(np.array([0.0, 0.0, np.sin(0.2), np.cos(0.2)])), 6)
    0.4
    """
    x, y, z, w = np.asarray(quat_xyzw, dtype=float)
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
