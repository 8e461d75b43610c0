"""The Franka Panda's numbers and its kinematics in NumPy: what every part of `hardware` shares.

The tool centre point (TCP) lies between the fingertips of the Franka hand, 0.1034 m below the
flange; its z axis points out of the hand, and the fingers travel along its y axis.

Source: Franka Control Interface documentation, "Robot and interface specifications" (modified
Denavit-Hartenberg parameters; limits of the Panda).
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "DDQ_MAX",
    "DH_A",
    "DH_ALPHA",
    "DH_D",
    "DQ_MAX",
    "FLANGE",
    "GRIPPER_MAX_WIDTH",
    "HOME_Q",
    "Q_MAX",
    "Q_MIN",
    "TAU_MAX",
    "PandaKinematics",
    "flange_T_tcp",
]

DH_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)  # [m]
DH_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)  # [m]
DH_ALPHA = tuple(np.pi / 2 * quarters for quarters in (0, -1, 1, 1, -1, 1, 1))  # [rad]
FLANGE = 0.107  # [m] from joint 7's frame
Q_MIN = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # [rad]
Q_MAX = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # [rad]
DQ_MAX = np.array([2.175] * 4 + [2.61] * 3)  # [rad/s]
DDQ_MAX = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])  # [rad/s^2]
TAU_MAX = np.array([87.0] * 4 + [12.0] * 3)  # [N m]
for _limit in (Q_MIN, Q_MAX, DQ_MAX, DDQ_MAX, TAU_MAX):
    _limit.flags.writeable = False  # whoever writes into them would move the limits of all
# The vendor's ready pose: the hand points straight down, 0.31 m ahead and 0.49 m up.
HOME_Q = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)
GRIPPER_MAX_WIDTH = 0.08  # [m]
HAND_LENGTH, HAND_YAW = 0.1034, -np.pi / 4


def flange_T_tcp() -> np.ndarray:
    """Return the pose of the TCP on the flange, shape (4, 4) [m]."""
    c, s = np.cos(HAND_YAW), np.sin(HAND_YAW)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, HAND_LENGTH], [0, 0, 0, 1.0]])


def _links() -> np.ndarray:
    """Return what a joint's angle does not change of the links' transforms, (7, 4, 4) [m]."""
    links = np.zeros((7, 4, 4))
    for link, a, d, alpha in zip(links, DH_A, DH_D, DH_ALPHA, strict=True):
        ca, sa = np.cos(alpha), np.sin(alpha)
        link[:, 2:] = [[0.0, a], [-sa, -d * sa], [ca, d * ca], [0.0, 1.0]]
    return links


def _joint_7_T_flange() -> np.ndarray:
    """Return the pose of the flange in joint 7's frame, (4, 4) [m]."""
    flange = np.eye(4)
    flange[2, 3] = FLANGE
    return flange


# Motions are planned and checked in thousands of poses; what is the same for all is made once.
_LINKS = _links()
_ALPHA_COSINES, _ALPHA_SINES = np.cos(DH_ALPHA), np.sin(DH_ALPHA)
_BASE, _JOINT_7_T_FLANGE, _FLANGE_T_TCP = np.eye(4), _joint_7_T_flange(), flange_T_tcp()
_JOINT_7_T_TCP = _JOINT_7_T_FLANGE @ _FLANGE_T_TCP


class PandaKinematics:
    """Forward kinematics and Jacobian of the nominal arm; a real one differs by some 0.1 mm."""

    def pose(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (4, 4) [m] of joint positions [rad] (7,)."""
        return self._chain(q)[0]

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (N, 4, 4) [m] of many joint positions [rad] (N, 7) at once."""
        T = np.broadcast_to(_BASE, (len(q), 4, 4))
        for link in self._link_transforms(np.asarray(q).T):
            T = T @ link
        return T @ _JOINT_7_T_TCP

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the TCP's Jacobian in the base frame, shape (6, 7) [m, rad]."""
        base_T_tcp, axes, origins = self._chain(q)
        (x, y, z), (a, b, c) = axes.T, (base_T_tcp[:3, 3] - origins).T
        columns = np.stack([y * c - z * b, z * a - x * c, x * b - y * a, x, y, z], axis=1)
        return columns.T

    @classmethod
    def _chain(cls, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return base_T_tcp, and the joints' axes and origins, each (7, 3)."""
        T, frames = _BASE, np.empty((7, 4, 4))
        for link, frame in zip(cls._link_transforms(q), frames, strict=True):
            T = np.matmul(T, link, out=frame)
        return T @ _JOINT_7_T_FLANGE @ _FLANGE_T_TCP, frames[:, :3, 2], frames[:, :3, 3]

    @staticmethod
    def _link_transforms(q: np.ndarray) -> np.ndarray:
        """Return each link's transform (7, ..., 4, 4) [m] at its joint's angles (7, ...) [rad]."""
        q = np.asarray(q, dtype=np.float64)
        across = (slice(None), *(None,) * (q.ndim - 1))
        ca, sa = _ALPHA_COSINES[across], _ALPHA_SINES[across]
        ct, st = np.cos(q), np.sin(q)
        links = np.empty((*q.shape, 4, 4))
        links[...] = _LINKS[across]
        links[..., 0, 0], links[..., 0, 1] = ct, -st
        links[..., 1, 0], links[..., 1, 1] = st * ca, ct * ca
        links[..., 2, 0], links[..., 2, 1] = st * sa, ct * sa
        return links
