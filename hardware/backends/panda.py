"""The Franka Panda (FER) through panda-python: libfranka 0.9, server version 5, no ROS.

Motions go through joint way-points, because the vendor's Cartesian controller stops millimetres
short. Straight lines are solved on the robot's own kinematic model.

Never run on a physical robot by the authors: tested with the vendor's wheel against
`hardware.emulator`. Stopping by software is no safety function; keep the user stop in your hand.
"""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ..closing import Closing
from ..joint_path import path_pieces
from ..panda_arm import DDQ_MAX, DQ_MAX, GRIPPER_MAX_WIDTH
from ..robot import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    GraspError,
    IncompatibleVersion,
    MotionError,
    MoveResult,
    ReflexError,
    RobotError,
    RobotMode,
    RobotState,
    UserStopped,
    check_joints,
    check_pose,
    check_range,
)
from ..straight_line import distance, straight_line
from .bounded import run_bounded
from .franka_config import NetworkedConfig
from .libfranka_errors import reflex_names, typed_error

__all__ = ["PandaRobot"]

T = TypeVar("T")
# A reading or setting takes milliseconds; libfranka itself gives up after 1 s without a state.
QUICK_TIMEOUT = 5.0  # [s]
# The vendor's planner gives up after 30 s.
PLANNING_TIMEOUT = 35.0  # [s]
# A reading while the vendor plans keeps a motion from starting: for so long the last one is given
# instead [s], and where planning takes longer the motion is tried again.
STARTING = 0.3
STARTS = 5
BUSY = "another control or read operation is running"
# A grasp tolerance as wide as the hand: outside it the real hand reopens, so held or not is decided
# from the measured width instead.
WIDE = GRIPPER_MAX_WIDTH
MODES = {
    "kIdle": RobotMode.IDLE,
    "kMove": RobotMode.MOVING,
    "kGuiding": RobotMode.GUIDING,
    "kReflex": RobotMode.REFLEX,
    "kUserStopped": RobotMode.USER_STOPPED,
    "kAutomaticErrorRecovery": RobotMode.RECOVERING,
}


class PandaRobot(Closing):
    """A `Robot`: a Franka Panda with its hand.

    Connecting loads the robot's model and reads a state; it moves nothing. A robot that stands in a
    reflex or with its user stop pressed connects all the same: state() says so, motions are refused
    until recover(). state() and stop() may be called from other threads while the arm moves.

    Raises:
        BackendMissing: panda-python is not installed
        IncompatibleVersion: the robot is no Panda of system version 4.2 or later
        ConnectionFailed: nothing answers, FCI is not active, or another client has it
    """

    def __init__(self, config: NetworkedConfig | None = None) -> None:
        self.config = config or NetworkedConfig()
        check_range("collision_force_N", self.config.collision_force_N, low=0, high=100, unit="N")
        try:
            import panda_py
            from panda_py import libfranka
        except ImportError as error:
            raise BackendMissing(f"panda-python cannot be loaded: {error}") from error
        self._libfranka = libfranka
        # Without a handler the vendor's warnings would go to stderr; an application may add one.
        logging.getLogger("panda").addHandler(logging.NullHandler())
        logging.getLogger("motion").addHandler(logging.NullHandler())
        self._closed = False
        self._following = False
        self._begun = 0.0
        self._reading = threading.Lock()
        self._thresholds_set = False
        self._panda = self._connect(lambda: panda_py.Panda(self.config.host))
        # When the robot goes away, the vendor's destructor ends the whole process. So nothing
        # destroys the object until close() has seen that the robot is still there.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._panda))
        self._robot = self._panda.get_robot()
        try:
            self._gripper = self._connect(lambda: libfranka.Gripper(self.config.host))
            reading = self._read()
        except RobotError:
            self.close()
            raise
        self._frames = [list(reading.F_T_EE), list(reading.EE_T_K)]

    def _connect(self, make: Callable[[], Any]) -> Any:
        timeout = self.config.connect_timeout_s
        try:
            return run_bounded(make, timeout_s=timeout)
        except TimeoutError as error:
            raise ConnectionFailed(f"{self.config.host} gave no answer in {timeout:g} s") from error
        except RuntimeError as error:
            if "version" in str(error).lower():
                raise IncompatibleVersion(str(error)) from error
            raise ConnectionFailed(f"{self.config.host}: {error}") from error

    # Kinematics of the robot's own model, for straight_line.

    def pose(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (4, 4) [m] of joint positions [rad] (7,), by the robot's own model."""
        frame = self._libfranka.Frame.kEndEffector
        flat = self._panda.get_model().pose(frame, list(q), *self._frames)
        return np.array(flat).reshape(4, 4).T

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the TCP's Jacobian in the base frame (6, 7), by the robot's own model."""
        frame = self._libfranka.Frame.kEndEffector
        flat = self._panda.get_model().zero_jacobian(frame, list(q), *self._frames)
        return np.array(flat).reshape(7, 6).T

    # The protocol.

    def state(self) -> RobotState:
        """Read the robot now; see `Robot.state`."""
        reading = self._read()
        return RobotState(
            q=np.array(reading.q),
            base_T_tcp=np.array(reading.O_T_EE).reshape(4, 4).T,
            force_N=np.array(reading.O_F_ext_hat_K),
            gripper_width_m=float(self._quick(lambda: self._gripper.read_once()).width),
            mode=MODES.get(reading.robot_mode.name, RobotMode.OTHER),
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint way-points; see `Robot.move_joints`.

        The vendor's controller overshoots by up to 12 %: above a speed of about 0.85 the robot may
        stop itself with joint_velocity_violation.
        """
        points = check_joints(q)
        check_range("speed", speed, low=0.0, high=1.0, unit="of the greatest speed")
        self._move(points, speed)

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`.

        `stop_force_N` becomes the robot's own collision threshold, which it watches at 1 kHz; the
        reflex that ends the motion is recovered from at once.
        """
        target = check_pose(base_T_tcp)
        check_range("speed", speed, low=0.0, high=1.7, unit="m/s")
        plan = straight_line(self, np.array(self._ready().q), target, speed=speed)
        contact = False
        if stop_force_N is None:
            self._move(plan.q, plan.speed_factor, target)
        else:
            limit = self.config.collision_force_N
            check_range("stop_force_N", stop_force_N, low=0.0, high=limit, unit="N")
            contact = self._move_until(stop_force_N, plan.q, plan.speed_factor, target)
        return MoveResult(np.array(self._read().O_T_EE).reshape(4, 4).T, contact)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        if not self._finger(lambda: self._gripper.move(width_m, self.config.gripper_speed)):
            raise GraspError(f"the fingers did not open to {width_m} m")

    def home_gripper(self) -> None:
        """Close and open the fingers to find their zero; needed once after the hand was powered.

        Raises:
            GraspError: they did not get through
        """
        if not self._finger(lambda: self._gripper.homing()):
            raise GraspError("the fingers could not be homed")

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        speed = self.config.gripper_speed
        self._finger(lambda: self._gripper.grasp(width_m, speed, force_N, WIDE, WIDE))
        width = float(self._quick(lambda: self._gripper.read_once()).width)
        return self.config.min_held_m < width <= width_m + self.config.held_tolerance_m

    def stop(self) -> None:
        """End the motion in progress; see `Robot.stop`."""
        self._quick(lambda: self._robot.stop())

    def recover(self) -> None:
        """Clear a reflex; see `Robot.recover`."""
        mode = self._mode(self._read())
        if mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if mode == RobotMode.REFLEX:
            self._quick(lambda: self._robot.automatic_error_recovery())
        mode = self._mode(self._read())
        if mode != RobotMode.IDLE:
            raise ReflexError(
                f"the robot is still in mode {mode.value} after recovery",
                advice="recover it by hand in Desk",
            )
        self._set_collision_force(self.config.collision_force_N)

    def close(self) -> None:
        """End the connection; see `Robot.close`."""
        if self._closed:
            return
        self._closed = True
        try:
            run_bounded(self._panda.stop_controller, timeout_s=QUICK_TIMEOUT)
            self._robot.read_once()
        except (RuntimeError, TimeoutError):
            return  # the robot has gone: see __init__
        panda = self._panda
        del self._panda, self._robot
        self._gripper = None
        ctypes.pythonapi.Py_DecRef(ctypes.py_object(panda))

    # Below: the vendor's calls, with what they return and raise made into typed errors.

    def _quick(self, call: Callable[[], T]) -> T:
        """Make a call that takes milliseconds."""
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        try:
            return run_bounded(call, timeout_s=QUICK_TIMEOUT)
        except TimeoutError as error:
            raise ConnectionLost(f"{self.config.host}: {error}") from error
        except RuntimeError as error:
            raise typed_error(str(error), host=self.config.host) from error

    def _read(self) -> Any:
        """Return a libfranka state that the robot sent after this call, or the motion's latest."""
        with self._reading:
            if not self._following:
                # The first may have waited in a buffer since nobody read; the second is fresh.
                self._quick(lambda: self._robot.read_once())
                self._latest = self._quick(lambda: self._robot.read_once())
            if not self._following or time.monotonic() - self._begun < STARTING:
                return self._latest
        return self._quick(lambda: self._panda.get_state())

    @staticmethod
    def _mode(reading: Any) -> RobotMode:
        return MODES.get(reading.robot_mode.name, RobotMode.OTHER)

    def _ready(self) -> Any:
        """Return a fresh state of a robot that accepts motions.

        The vendor recovers from a reflex by itself before a motion, without a word; here that takes
        a call to recover().
        """
        reading = self._read()
        mode = self._mode(reading)
        if mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if mode == RobotMode.REFLEX:
            reflexes = reflex_names(str(reading.last_motion_errors))
            raise ReflexError(f"the robot stands in a reflex: {reflexes}", reflexes=reflexes)
        if mode != RobotMode.IDLE:
            raise MotionError(f"the robot is in mode {mode.value} and accepts no motion")
        if not self._thresholds_set:
            self._set_collision_force(self.config.collision_force_N)
        return reading

    def _move(self, points: np.ndarray, factor: float, target: np.ndarray | None = None) -> None:
        """Go through `points` (N, 7) and check that the TCP arrived (at `target`)."""
        start = np.array(self._ready().q)
        target = self.pose(points[-1]) if target is None else target
        for begin, piece in path_pieces(start, points):
            for left in reversed(range(STARTS)):
                try:
                    self._follow(begin, piece, factor)
                    break
                except MotionError as error:
                    if BUSY not in str(error) or not left:
                        raise
        reached = np.array(self._read().O_T_EE).reshape(4, 4).T
        off, turned = distance(reached, target)
        tolerance = self.config.arrival_tolerance_m, self.config.arrival_tolerance_rad
        if off > tolerance[0] or turned > tolerance[1]:
            raise MotionError(
                f"the TCP ended {1e3 * off:.1f} mm and {turned:.3f} rad from its target "
                f"(allowed: {1e3 * tolerance[0]:.1f} mm, {tolerance[1]:.3f} rad)"
            )

    def _follow(self, start: np.ndarray, points: np.ndarray, factor: float) -> None:
        steps = np.abs(np.diff(np.vstack([start, points]), axis=0))
        # Each step at its speed, and a start and a stop for each: no trajectory takes longer.
        longest = (steps / (factor * DQ_MAX)).max(axis=1) + (DQ_MAX / DDQ_MAX).max()
        columns = [point.reshape(7, 1) for point in points]
        clock = time.monotonic()
        self._forget_error()
        with self._reading:  # a reading in another thread would make the vendor refuse the motion
            self._following, self._begun = True, time.monotonic()
        try:
            ok = run_bounded(
                lambda: self._panda.move_to_joint_position(columns, speed_factor=factor),
                timeout_s=2.0 * float(longest.sum()) + PLANNING_TIMEOUT,
                stop=self._halt,
            )
            # A motion that fails says so only here: the vendor keeps the error for later.
            self._panda.raise_error()
        except TimeoutError as error:
            raise MotionError("the motion did not end in time and was stopped") from error
        except RuntimeError as error:
            raise typed_error(str(error), host=self.config.host) from error
        finally:
            self._following = False
        if not ok:
            took = time.monotonic() - clock
            raise MotionError(f"the motion ended after {took:.1f} s, before its last way-point")

    def _forget_error(self) -> None:
        """Drop the error of a motion that was interrupted: the vendor keeps it for the next."""
        try:
            self._panda.raise_error()
        except RuntimeError as error:
            logging.getLogger(__name__).info("an earlier motion ended with: %s", error)

    def _halt(self) -> None:
        """Stop a motion that runs in another thread, as well as that can be done."""
        try:
            self._robot.stop()
        except RuntimeError as error:
            logging.getLogger(__name__).warning("stopping the motion failed: %s", error)

    def _move_until(
        self, force: float, points: np.ndarray, factor: float, target: np.ndarray
    ) -> bool:
        """Go through `points` until a force component exceeds `force` [N]; returns whether so."""
        self._set_collision_force(force)
        try:
            self._move(points, factor, target)
        except ReflexError as error:
            if "cartesian_reflex" not in error.reflexes:
                raise
            self._quick(lambda: self._robot.automatic_error_recovery())
            return True
        finally:
            if self._mode(self._read()) == RobotMode.IDLE:
                self._set_collision_force(self.config.collision_force_N)
        return False

    def _set_collision_force(self, force: float) -> None:
        """Make the robot stop itself at a force on the hand [N]; contact is reported at half."""
        torque = [self.config.collision_torque_Nm] * 7
        # Torques on the hand keep their threshold: the force is what a descent should feel.
        forces = [force] * 3 + [self.config.collision_force_N] * 3
        self._quick(
            lambda: self._robot.set_collision_behavior(
                [0.5 * t for t in torque], torque, [0.5 * f for f in forces], forces
            )
        )
        self._thresholds_set = True

    def _finger(self, call: Callable[[], bool]) -> bool:
        """Make a call that moves the fingers; returns whether the hand calls it a success."""
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        # Homing goes there and back at the hand's own pace.
        timeout = 4.0 * GRIPPER_MAX_WIDTH / min(self.config.gripper_speed, 0.05) + QUICK_TIMEOUT
        try:
            return run_bounded(call, timeout_s=timeout, stop=self._halt_fingers)
        except TimeoutError as error:
            raise GraspError("the fingers did not stop in time") from error
        except RuntimeError as error:
            lost = typed_error(str(error), host=self.config.host)
            raise lost if isinstance(lost, ConnectionLost) else GraspError(str(error)) from error

    def _halt_fingers(self) -> None:
        try:
            self._gripper.stop()
        except RuntimeError as error:
            logging.getLogger(__name__).warning("stopping the fingers failed: %s", error)
