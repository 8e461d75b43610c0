"""A robot that records what reaches it, and the limits written down a second time."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from hardware import MoveResult, RobotMode, RobotState
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q, Q_MAX, Q_MIN, PandaKinematics
from hardware.arm.straight_line import straight_line

ARM = PandaKinematics()
HOME = np.array(HOME_Q)


@dataclass
class SpyRobot:
    """Does what it is told, at once, and misses its targets by `miss` [rad] of joint 2."""

    q: np.ndarray = field(default_factory=lambda: HOME.copy())
    width: float = 0.08
    object_width: float = 0.004
    mode: RobotMode = RobotMode.IDLE
    miss: float = 0.0
    contact_at: float | None = None
    """Height of the TCP at which a line with a stop force meets something [m]."""
    wrong_tcp: np.ndarray = field(default_factory=lambda: np.zeros(3))
    hold_for: int = 10**9
    """Readings of the width after which the fingers lose what they hold."""
    lines: list[tuple] = field(default_factory=list)
    joints: list[tuple] = field(default_factory=list)
    force: np.ndarray = field(default_factory=lambda: np.zeros(6))
    log: list[str] = field(default_factory=list)
    interrupt: bool = False

    def state(self) -> RobotState:
        T = ARM.pose(self.q)
        T[:3, 3] += self.wrong_tcp
        return RobotState(self.q.copy(), T, self.force, self.width, self.mode)

    def _arrive(self, q: np.ndarray) -> None:
        if self.interrupt:
            raise KeyboardInterrupt
        self.q = q.copy()
        self.q[1] += self.miss

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        self.log.append("move_joints")
        self.joints.append((self.q.copy(), q.copy(), speed))
        self._arrive(q[-1])

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        self.log.append("move_linear")
        start = ARM.pose(self.q)
        self.lines.append((start, base_T_tcp.copy(), speed, stop_force_N))
        target = base_T_tcp.copy()
        contact = (
            stop_force_N is not None
            and self.contact_at is not None
            and target[2, 3] < self.contact_at < start[2, 3]
        )
        if contact:
            share = (start[2, 3] - self.contact_at) / (start[2, 3] - target[2, 3])
            target[:3, 3] = start[:3, 3] + share * (target[:3, 3] - start[:3, 3])
        self._arrive(straight_line(ARM, self.q, target, speed=speed).q[-1])
        return MoveResult(ARM.pose(self.q), contact)

    def open_gripper(self, width_m: float = 0.08) -> None:
        self.log.append("open_gripper")
        self.width = width_m

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        self.log.append("grasp")
        self.width = min(self.object_width, self.width)
        return self.width > 5e-4

    def stop(self) -> None:
        self.log.append("stop")

    def recover(self) -> None:
        self.log.append("recover")
        self.mode = RobotMode.IDLE

    def close(self) -> None:
        self.log.append("close")

    def __enter__(self) -> SpyRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def worst(limits: SafetyLimits, poses: np.ndarray) -> float:
    """How far the TCP of poses (N, 4, 4) is outside of box, floor and tilt; within: below 0."""
    x, y, z = poses[:, 0, 3], poses[:, 1, 3], poses[:, 2, 3]
    t = limits.table
    floor = t.height_m + t.slope_x * x + t.slope_y * y + limits.min_tcp_height_m
    m = limits.margin_m
    tilt = np.arccos(np.clip(-poses[:, 2, 2], -1.0, 1.0))
    return float(
        np.max(
            [
                x - (limits.x[1] + m),
                (limits.x[0] - m) - x,
                y - (limits.y[1] + m),
                (limits.y[0] - m) - y,
                z - limits.max_z_m,
                floor - z,
                tilt - limits.max_tilt_rad,
            ]
        )
    )


def assert_within(limits: SafetyLimits, spy: SpyRobot) -> None:
    """Everything that reached the spy keeps the limits, and so does what lies in between.

    Where a motion started is measured, not commanded: a segment may be as far out as its start.
    """
    shares = np.linspace(0.0, 1.0, 33)[:, None]
    for start, target, speed, force in spy.lines:
        assert worst(limits, target[None]) < 1e-8
        segment = np.tile(target, (33, 1, 1))
        segment[:, :3, 3] = start[:3, 3] + shares * (target[:3, 3] - start[:3, 3])
        out = max(worst(limits, start[None]), 0.0)
        assert out <= limits.arrival_tolerance_m
        assert worst(limits, segment) <= out + 1e-8
        assert 0.0 < speed <= limits.max_speed
        heights = [T[2, 3] - limits.table.z(T[:2, 3]) for T in (start, target)]
        if heights[0] - heights[1] > 1.01e-3:
            assert speed <= limits.max_descent_speed
            assert force is not None or heights[1] >= limits.contact_height_m
        assert force is None or 0.0 < force <= limits.max_contact_force_N
    for start, points, speed in spy.joints:
        assert worst(limits, ARM.poses(points)) < 1e-8
        slack = limits.joint_margin * (Q_MAX - Q_MIN)
        assert (points >= Q_MIN + slack).all() and (points <= Q_MAX - slack).all()
        path = np.vstack([start, points])
        assert np.abs(np.diff(path, axis=0)).max() <= limits.max_joint_step_rad
        out = max(worst(limits, ARM.poses(path[:1])), 0.0)
        for a, b in pairwise(path):
            between = ARM.poses(a + shares * (b - a))
            assert worst(limits, between) <= out + 2e-4
            heights = between[:, 2, 3] - limits.table.z(between[:, :2, 3])
            assert heights.min() >= limits.contact_height_m - limits.arrival_tolerance_m - 2e-4
        assert 0.0 < speed <= limits.max_joint_speed


def pose(x: float = 0.45, y: float = 0.0, z: float = 0.2, *, tilt: float = 0.0) -> np.ndarray:
    """The hand pointing down, leaning by `tilt` [rad] about x."""
    c, s = np.cos(tilt), np.sin(tilt)
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = x, y, z
    return T


def joints_at(T: np.ndarray) -> np.ndarray:
    return straight_line(ARM, HOME, T, speed=0.1).q[-1]
