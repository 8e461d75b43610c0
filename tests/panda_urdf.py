"""Forward kinematics of the Panda a second time: from the vendor's URDF, not the product's table.

Source: franka_description, `panda_arm.xacro` and `hand.xacro`.
"""

from __future__ import annotations

import numpy as np

# Origins of the joints in the frames before them: x, y, z [m], and the turn about x [quarters].
URDF = ((0, 0, 0.333, 0), (0, 0, 0, -1), (0, -0.316, 0, 1), (0.0825, 0, 0, 1),
        (-0.0825, 0.384, 0, -1), (0, 0, 0, 1), (0.088, 0, 0, 1))  # fmt: skip
FLANGE_Z, HAND_YAW, TCP_Z = 0.107, -np.pi / 4, 0.1034  # [m], [rad], [m]


def poses(q: np.ndarray) -> np.ndarray:
    """Return base_T_tcp (N, 4, 4) [m] of joint positions (N, 7) [rad]."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for (x, y, z, quarters), angle in zip(URDF, q.T, strict=True):
        T = T @ placed(x, y, z) @ about_x(quarters) @ about_z(angle)
    hand = placed(0, 0, FLANGE_Z) @ about_z(np.array([HAND_YAW]))[0] @ placed(0, 0, TCP_Z)
    return T @ hand


def placed(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def about_x(quarters: int) -> np.ndarray:
    T = np.eye(4)
    T[1:3, 1:3] = [[1 - abs(quarters), -quarters], [quarters, 1 - abs(quarters)]]
    return T


def about_z(angles: np.ndarray) -> np.ndarray:
    T = np.tile(np.eye(4), (len(angles), 1, 1))
    c, s = np.cos(angles), np.sin(angles)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    return T
