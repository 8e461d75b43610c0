"""Joint waypoints along a straight motion of the TCP, solved on the robot's own kinematics.

Damped Gauss-Newton from each waypoint to the next, so the arm never changes its configuration on
the way; what freedom is left goes towards a rest posture, a little a step, so that many motions do
not let the elbow wander.

Source: Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, section 3.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .panda import HOME_Q, Q_MAX, Q_MIN
from .path_speed import OVERSHOOT, fitting_share
from .robot import UnreachablePose

__all__ = ["Kinematics", "StraightLine", "distance", "straight_line"]

# Waypoints this far apart keep the TCP within 0.1 mm of the line [m], [rad].
SPACING, TURN_SPACING = 0.01, 0.05
# Joints stay this share of their range away from its ends: the vendor's controller pushes back
# within about 0.1 rad of them.
MARGIN = 0.03
MAX_JUMP = 0.5  # [rad] between waypoints; more means that the arm folds over
POSITION_TOLERANCE, TURN_TOLERANCE = 1e-5, 1e-4  # [m], [rad]
ITERATIONS = 30
_DAMPING = 1e-8 * np.eye(6)
# Greatest motion towards the rest posture in one waypoint [rad].
REST_STEP = 0.02
_REST = np.array(HOME_Q)


class Kinematics(Protocol):
    """Where the TCP is and how it moves with the joints."""

    def pose(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (4, 4) of joint positions (7,)."""
        ...

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the TCP's Jacobian in the base frame (6, 7)."""
        ...


@dataclass(frozen=True)
class StraightLine:
    """A planned motion.

    Attributes:
        q: joint waypoints after the start [rad], shape (N, 7)
        speed_factor: share of the joints' greatest speeds that keeps the TCP's speed
    """

    q: np.ndarray
    speed_factor: float


def straight_line(
    kinematics: Kinematics, q: np.ndarray, base_T_tcp: np.ndarray, *, speed: float
) -> StraightLine:
    """Plan the straight motion from where `q` (7,) puts the TCP to `base_T_tcp` at `speed` [m/s].

    Raises:
        UnreachablePose: a waypoint has no joint positions within the limits near the last one
    """
    start = kinematics.pose(q)
    length, turn = distance(start, base_T_tcp)
    count = max(int(np.ceil(length / SPACING)), int(np.ceil(turn / TURN_SPACING)), 1)
    axis = _rotation_vector(base_T_tcp[:3, :3] @ start[:3, :3].T)
    points, poses = [np.asarray(q, dtype=np.float64)], [start]
    for i in range(1, count + 1):
        target = base_T_tcp.copy()
        if i < count:
            share = i / count
            target[:3, 3] = (1 - share) * start[:3, 3] + share * base_T_tcp[:3, 3]
            target[:3, :3] = _rotation(share * axis) @ start[:3, :3]
        point, pose = _solve(kinematics, points[-1], target)
        points.append(point)
        poses.append(pose)
    path = np.array(points)
    share = fitting_share(path, np.array(poses), max_speed=speed)
    return StraightLine(path[1:], min(share, 1.0 / OVERSHOOT))


def distance(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return how far pose b is from pose a, (4, 4) each: translation [m] and angle [rad]."""
    turn = _rotation_vector(b[:3, :3] @ a[:3, :3].T)
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), float(np.linalg.norm(turn))


def _solve(
    kinematics: Kinematics, start: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions (7,) near `start` that put the TCP at `target`, and where exactly."""
    q = start.copy()
    where = f"({', '.join(f'{x:.3f}' for x in target[:3, 3])}) m"
    for iteration in range(ITERATIONS):
        pose = kinematics.pose(q)
        error = np.concatenate(
            [target[:3, 3] - pose[:3, 3], _rotation_vector(target[:3, :3] @ pose[:3, :3].T)]
        )
        small = np.linalg.norm(error[:3]) < POSITION_TOLERANCE
        if small and np.linalg.norm(error[3:]) < TURN_TOLERANCE and iteration:
            break
        J = kinematics.jacobian(q)
        pseudo_inverse = J.T @ np.linalg.inv(J @ J.T + _DAMPING)
        step = pseudo_inverse @ error
        if not iteration:
            rest = _REST - q
            rest -= pseudo_inverse @ (J @ rest)
            step += rest * min(1.0, REST_STEP / max(float(np.linalg.norm(rest)), 1e-12))
        q = q + step
        if np.abs(q - start).max() > MAX_JUMP:
            raise UnreachablePose(f"the arm would have to fold over to put the TCP at {where}")
    else:
        raise UnreachablePose(f"no joint positions put the TCP at {where}")
    slack = MARGIN * (Q_MAX - Q_MIN)
    beyond = ((q < Q_MIN + slack) & (q < start)) | ((q > Q_MAX - slack) & (q > start))
    if beyond.any():
        joint = int(np.argmax(beyond)) + 1
        raise UnreachablePose(f"joint {joint} would come too near its limit for the TCP at {where}")
    return q, pose


def _rotation_vector(R: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] (3,) of a rotation matrix (3, 3)."""
    twice_sine = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    angle = np.arctan2(np.linalg.norm(twice_sine), np.trace(R) - 1.0)
    if angle < np.pi - 1e-6:
        # np.sinc keeps small angles exact: angle / (2 sin angle) -> 1/2.
        vector: np.ndarray = twice_sine / (2.0 * np.sinc(angle / np.pi))
        return vector
    axis = np.sqrt(np.maximum(np.diag(R) + 1.0, 0.0) / 2.0)
    column = int(np.argmax(axis))
    axis = (R[:, column] + np.eye(3)[column]) / (2.0 * axis[column])
    half_turn: np.ndarray = angle * axis
    return half_turn


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector [rad] (3,); Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = vector
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half * half * K @ K
