"""A robot in software that moves a simulated chain: to rehearse an episode without any robot.

Motions follow their joint waypoints exactly, begin and end at rest, and pass in simulated time, as
fast as the computer goes. Contact stops a descent, or the arm by a reflex, as on the robot. What is
not simulated: the arm's dynamics (for those run the vendor's client on `hardware.emulator`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arm.arguments import check_joints, check_line, check_range
from ..arm.joint_path import path_pieces
from ..arm.panda import DDQ_MAX, DQ_MAX, GRIPPER_MAX_WIDTH, HOME_Q, PandaKinematics
from ..arm.robot import (
    ConnectionLost,
    GraspError,
    MotionError,
    MoveResult,
    ReflexError,
    RobotMode,
    RobotState,
)
from ..arm.stop_latch import StopLatch
from ..arm.straight_line import straight_line
from ..emulator.world import Contact, Hand, World
from ..support.closing import Closing

__all__ = ["SimRobot", "SimRobotConfig"]

_ARRIVED = 1e-9  # [m]
_REFLEX = "cartesian_reflex"


@dataclass(frozen=True, kw_only=True)
class SimRobotConfig:
    """How the simulated robot starts and judges."""

    q: tuple[float, ...] = HOME_Q
    """Joint positions at the start [rad]."""
    gripper_width_m: float = GRIPPER_MAX_WIDTH
    """Opening of the fingers at the start [m]."""
    gripper_speed: float = 0.05
    """Speed of the opening [m/s]."""
    collision_force_N: float = 20.0
    """Force on the hand that makes the robot stop itself [N]."""
    min_held_m: float = 5e-4
    """Opening after a grasp at and below which the fingers hold nothing [m]."""
    held_tolerance_m: float = 5e-3
    """How much wider than expected a held object may be [m]."""
    dt: float = 1e-3
    """Step of the motion [s]."""


class SimRobot(Closing):
    """A `Robot` in a simulated world, `hardware.twin.twin.CableTwin` say.

    Args:
        world: what surrounds the hand
        config: start, gripper and reflexes
    """

    def __init__(self, world: World, config: SimRobotConfig | None = None) -> None:
        self.config = config or SimRobotConfig()
        self._world = world
        self._arm = PandaKinematics()
        self._q = check_joints(np.array(self.config.q))[0]
        self._pose = self._arm.pose(self._q)
        self._width = self.config.gripper_width_m
        self._pressing = False
        self._contact = Contact()
        self._mode = RobotMode.IDLE
        self._latch = StopLatch()
        self._closed = False

    def state(self) -> RobotState:
        """Read the robot now; see `Robot.state`."""
        self._check_open()
        return RobotState(
            q=self._q.copy(),
            base_T_tcp=self._pose.copy(),
            force_N=np.array(self._contact.wrench, dtype=np.float64),
            gripper_width_m=self._width,
            mode=self._mode,
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint waypoints; see `Robot.move_joints`."""
        points = check_joints(q)
        check_range("speed", speed, low=0.0, high=1.0, unit="of the greatest speed")
        self._move(points, speed, None)

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`."""
        high = self.config.collision_force_N
        target = check_line(base_T_tcp, speed=speed, stop_force_N=stop_force_N, most_force_N=high)
        self._check_ready()
        plan = straight_line(self._arm, self._q, target, speed=speed)
        contact = self._move(plan.q, plan.speed_factor, stop_force_N)
        return MoveResult(self._pose.copy(), contact)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        self._check_open()
        self._latch.check()
        self._pressing = False
        if not self._fingers(width_m):
            raise GraspError(f"the fingers did not get to {width_m} m: something is between them")

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        self._check_open()
        self._latch.check()
        self._pressing = True
        self._fingers(0.0)
        self._tick()  # what the fingers have reached, they grip
        return self.config.min_held_m < self._width <= width_m + self.config.held_tolerance_m

    def stop(self) -> None:
        """End the motion in progress, and let none begin until `recover`; see `Robot.stop`."""
        self._latch.press()

    def recover(self) -> None:
        """Clear a reflex and a stop; see `Robot.recover`."""
        mark = self._latch.mark()
        self._check_open()
        self._mode = RobotMode.IDLE
        self._latch.release(mark)

    def close(self) -> None:
        """Accept nothing more."""
        self._closed = True

    # Below: time passes.

    def _check_open(self) -> None:
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")

    def _check_ready(self) -> None:
        self._check_open()
        if self._mode is RobotMode.REFLEX:
            raise ReflexError("the robot stands in a reflex", reflexes=(_REFLEX,))

    def _tick(self) -> None:
        """Let one step pass where the arm is, with fingers that close on as they press."""
        dt = self.config.dt
        if self._pressing and self._width > self._contact.object_width + _ARRIVED:
            reach = self.config.gripper_speed * dt
            self._width = max(self._width - reach, self._contact.object_width)
        hand = Hand(self._pose, np.zeros(3), self._width, self._pressing, dt)
        self._contact = self._world.step(hand)

    def _fingers(self, target: float) -> bool:
        """Move the fingers to `target` [m] or to what is between them; returns whether there."""
        reach = self.config.gripper_speed * self.config.dt
        while abs(self._width - target) > _ARRIVED:
            if target > self._width:
                self._width = min(self._width + reach, target)
            elif self._width <= max(self._contact.object_width, target) + _ARRIVED:
                return False
            elif not self._pressing:
                self._width = max(self._width - reach, target, self._contact.object_width)
            self._tick()
        return True

    def _move(self, points: np.ndarray, factor: float, stop_force: float | None) -> bool:
        """Go through `points` (N, 7); returns whether contact ended it."""
        self._check_ready()
        self._latch.check()
        force = self._force()
        for begin, piece in path_pieces(self._q, points):
            for q, pose in self._samples(np.vstack([begin, piece]), factor):
                self._mode = RobotMode.MOVING
                try:
                    self._q, self._pose = q, pose
                    self._tick()
                finally:
                    self._mode = RobotMode.IDLE
                before, force = force, self._force()
                if self._latch.pressed:
                    raise MotionError("the motion was stopped")
                if force <= before:
                    continue  # an arm that leaves what it touches is not stopped
                if stop_force is not None and force > stop_force:
                    return True
                if force > self.config.collision_force_N:
                    self._mode = RobotMode.REFLEX
                    raise ReflexError(f"the hand met {force:.0f} N", reflexes=(_REFLEX,))
        return False

    def _force(self) -> float:
        """Greatest component of the force on the hand [N]."""
        return max(map(abs, self._contact.wrench[:3]))

    def _samples(self, path: np.ndarray, factor: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Joint positions and poses at every step of the motion along `path` (N, 7)."""
        seconds = (np.abs(np.diff(path, axis=0)) / (factor * DQ_MAX)).max(axis=1)
        clock = np.concatenate([[0.0], np.cumsum(seconds)])
        # Begun and ended at rest, at the planned speed in between.
        ramp = min(float((factor * DQ_MAX / DDQ_MAX).max()) + 0.1, 0.5 * clock[-1])
        count = max(int(np.ceil((clock[-1] + ramp) / self.config.dt)), 1)
        t = np.linspace(0.0, clock[-1] + ramp, count + 1)[1:]
        end = clock[-1] + ramp
        rising = np.where(t < ramp, 0.5 * t**2 / ramp, t - 0.5 * ramp)
        left = end - t
        progress = np.where(left < ramp, clock[-1] - 0.5 * left**2 / ramp, rising)
        q = np.column_stack([np.interp(progress, clock, path[:, j]) for j in range(7)])
        q[-1] = path[-1]
        return list(zip(q, self._arm.poses(q), strict=True))
