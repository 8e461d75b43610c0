"""The Franka Research 3 through franky: server version 10, system 5.9 or later, no ROS.

Straight lines are the robot's own: franky's Cartesian motions with limited jerk, ended by its
reaction to force in the 1 kHz loop. So the elbow goes where the robot lets it. Its planner limits
each axis by itself and brings all to their ends at the same time, each on a profile of its own. So
a joint motion gets limits in proportion to the joints' ways, which makes the profiles alike and the
way straight; and a line's axes, of which three may be at their limit at once, share its speed.

Source: franky, `position_waypoint_motion.hpp` and `cartesian_waypoint_motion.cpp`.

Never run on a physical robot by the authors, nor on a simulated one in the tests: those use a
stand-in for franky that has its names. Stopping by software is no safety function.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from warp_deform.errors import InputError
from warp_deform.support.extras import install_extra

from ..arm.arguments import check_joints, check_line, check_range
from ..arm.arrival import check_arrival, check_joints_arrival
from ..arm.panda import DQ_MAX, GRIPPER_MAX_WIDTH
from ..arm.robot import (
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
)
from ..arm.stop_latch import StopLatch
from ..support.bounded import run_bounded
from ..support.closing import Closing
from .franka_config import RECOVERY_TIMEOUT, NetworkedConfig
from .libfranka_errors import typed_error

__all__ = ["FR3_Q_MAX", "FR3_Q_MIN", "FR3Robot"]

T = TypeVar("T")
FR3_Q_MIN = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])
"""Lowest joint positions of an FR3 [rad]; they differ from the Panda's."""
FR3_Q_MAX = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
"""Highest joint positions of an FR3 [rad]."""
_STANDSTILL = 1e-6  # [rad]: nowhere to go
_QUICK = 5.0  # [s]
_MOTION = 120.0  # [s]
_MODES = {
    "Idle": RobotMode.IDLE,
    "Move": RobotMode.MOVING,
    "Guiding": RobotMode.GUIDING,
    "Reflex": RobotMode.REFLEX,
    "UserStopped": RobotMode.USER_STOPPED,
    "AutomaticErrorRecovery": RobotMode.RECOVERING,
}


class FR3Robot(Closing):
    """A `Robot`: a Franka Research 3 with its hand. Connecting moves nothing.

    Raises:
        BackendMissing: franky-control is not installed
        IncompatibleVersion: the robot is no FR3 of system version 5.9 or later
        ConnectionFailed: nothing answers, FCI is not active, or another client has it
    """

    def __init__(self, config: NetworkedConfig | None = None) -> None:
        self.config = config or NetworkedConfig()
        try:
            import franky
        except ImportError as error:
            raise BackendMissing(
                f"franky cannot be loaded: {error}",
                advice=f"install it, in the clone: {install_extra('fr3')}",
            ) from error
        self._franky = franky
        self._closed = False
        self._latch = StopLatch()
        host = self.config.host
        # Without a real-time kernel, too: `franka doctor` says what that costs.
        self._robot = self._connect(
            lambda: franky.Robot(host, realtime_config=franky.RealtimeConfig.Ignore)
        )
        self._gripper = self._connect(lambda: franky.Gripper(host))
        c = self.config
        self._quick(
            lambda: self._robot.set_collision_behavior(c.collision_torque_Nm, c.collision_force_N)
        )

    def _connect(self, make: Callable[[], T]) -> T:
        config, franky = self.config, self._franky
        try:
            return run_bounded(make, timeout_s=config.connect_timeout_s)
        except TimeoutError as error:
            raise ConnectionFailed(
                f"{config.host} gave no answer in {config.connect_timeout_s:g} s"
            ) from error
        except franky.IncompatibleVersionException as error:
            raise IncompatibleVersion(
                str(error), advice="use --robot panda for a Panda; update an FR3 to system 5.9"
            ) from error
        except self._errors() as error:
            raise ConnectionFailed(f"{config.host}: {error}") from error

    def state(self) -> RobotState:
        """Read the robot now; see `Robot.state`."""
        reading = self._quick(lambda: self._robot.state)
        return RobotState(
            q=np.array(reading.q, dtype=float),
            base_T_tcp=np.array(reading.O_T_EE.matrix, dtype=float),
            force_N=np.array(reading.O_F_ext_hat_K, dtype=float),
            gripper_width_m=float(self._quick(lambda: self._gripper.width)),
            mode=_MODES.get(reading.robot_mode.name, RobotMode.OTHER),
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint waypoints; see `Robot.move_joints`. The arm rests at each.

        A share of the greatest speeds means those of the Panda, which has the slower joints.

        Raises:
            InputError: also beyond the FR3's own joint limits
        """
        points = check_joints(q)
        check_range("speed", speed, low=0.0, high=1.0, unit="of the greatest speed")
        beyond = (points < FR3_Q_MIN) | (points > FR3_Q_MAX)
        if beyond.any():
            joint = int(np.argwhere(beyond)[0][1])
            raise InputError(
                f"q: joint {joint + 1} is beyond an FR3's limits {FR3_Q_MIN[joint]} to "
                f"{FR3_Q_MAX[joint]}; choose another waypoint"
            )
        for start, end in pairwise([self.state().q, *points]):
            self._straight(start, end, speed)
        check_joints_arrival(self.config, self.state().q, points[-1])

    def _straight(self, start: np.ndarray, end: np.ndarray, speed: float) -> None:
        """Go from `start` to `end` (7,) [rad] with the joints in proportion."""
        ways = np.abs(end - start)
        if ways.max() < _STANDSTILL:
            return
        franky, robot = self._franky, self._robot
        # A joint that stays needs a limit above 0; it gets there at once.
        ways = np.maximum(ways, 1e-6 * ways.max())
        limits = (
            robot.joint_velocity_limit,
            robot.joint_acceleration_limit,
            robot.joint_jerk_limit,
        )
        before = [self._quick(limit.get) for limit in limits]
        tops = (speed * DQ_MAX, *(speed * np.array(limit) for limit in before[1:]))
        try:
            for limit, top in zip(limits, tops, strict=True):
                shares = (ways * float((top / ways).min())).tolist()
                self._quick(functools.partial(limit.set, shares))
            self._move(franky.JointMotion(franky.JointState(end.tolist())))
        finally:
            if not self._closed:
                for limit, value in zip(limits, before, strict=True):
                    self._quick(functools.partial(limit.set, np.array(value).tolist()))

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`."""
        high = self.config.collision_force_N
        target = check_line(base_T_tcp, speed=speed, stop_force_N=stop_force_N, most_force_N=high)
        franky = self._franky
        limit = float(self._robot.translation_velocity_limit.get())
        share = min(speed / (np.sqrt(3.0) * limit), 1.0)
        # The constructor takes a matrix: no quaternion, whose order differs between libraries.
        motion = franky.CartesianMotion(franky.Affine(target), relative_dynamics_factor=share)
        met = threading.Event()
        if stop_force_N is not None:
            condition = False
            for name in ("FORCE_X", "FORCE_Y", "FORCE_Z"):
                force = getattr(franky.Measure, name)
                condition = (force > stop_force_N) | (force < -stop_force_N) | condition
            reaction = franky.CartesianPoseReaction(condition, franky.CartesianStopMotion())
            reaction.register_callback(lambda *_: met.set())
            motion.add_reaction(reaction)
        self._move(motion)
        reached = self.state().base_T_tcp
        if met.is_set():
            return MoveResult(reached, contact=True)
        check_arrival(self.config, reached, target)
        return MoveResult(reached, contact=False)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        if not self._finger(lambda: self._gripper.move(width_m, self.config.gripper_speed)):
            raise GraspError(f"the fingers did not get to {width_m} m: something is between them")

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        speed, wide = self.config.gripper_speed, GRIPPER_MAX_WIDTH
        # A narrow tolerance makes the hand reopen; whether it holds says the measured width.
        self._finger(
            lambda: self._gripper.grasp(
                width_m, speed, force_N, epsilon_inner=wide, epsilon_outer=wide
            )
        )
        width = float(self._quick(lambda: self._gripper.width))
        return self.config.min_held_m < width <= width_m + self.config.held_tolerance_m

    def stop(self) -> None:
        """End the motion in progress, and let none begin until `recover`; see `Robot.stop`."""
        self._latch.stop(lambda: self._quick(lambda: self._robot.stop()))

    def recover(self) -> None:
        """Clear a reflex and a stop; see `Robot.recover`."""
        mark = self._latch.mark()
        mode = self.state().mode
        if mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if mode in (RobotMode.MOVING, RobotMode.GUIDING):
            raise ReflexError(
                f"the robot is in mode {mode.value}", advice="let it come to rest, then try again"
            )
        # Also where the state looks right: a user stop that was released does not show there.
        recovered = self._quick(
            lambda: self._robot.recover_from_errors(), timeout_s=RECOVERY_TIMEOUT
        )
        if not recovered:
            raise ReflexError("the robot does not recover", advice="recover it by hand in Desk")
        self._latch.release(mark)

    def close(self) -> None:
        """End the connection; see `Robot.close`."""
        self._closed = True
        self._robot = self._gripper = None

    # Below: franky's exceptions made into typed errors.

    def _errors(self) -> tuple[type[Exception], ...]:
        """Franky's base class; what it raises through its bindings alone is a RuntimeError."""
        return (self._franky.Exception, RuntimeError)

    def _typed(self, error: Exception) -> RobotError:
        if isinstance(error, self._franky.NetworkException):
            return ConnectionLost(f"{self.config.host}: {error}")
        return typed_error(str(error), host=self.config.host)

    def _quick(self, call: Callable[[], T], *, timeout_s: float = _QUICK) -> T:
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        try:
            return run_bounded(call, timeout_s=timeout_s)
        except TimeoutError as error:
            raise ConnectionLost(f"{self.config.host}: {error}") from error
        except self._errors() as error:
            raise self._typed(error) from error

    def _move(self, motion: Any) -> None:
        """Make a motion in another thread; Ctrl-C stops it, which `SafeRobot` lets hold."""
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        robot = self._robot
        try:
            with self._latch.motion():
                run_bounded(lambda: robot.move(motion), timeout_s=_MOTION, stop=robot.stop)
                if self._latch.pressed:
                    raise MotionError("the motion was stopped")
        except TimeoutError as error:
            raise MotionError("the motion did not end in time and was stopped") from error
        except self._errors() as error:
            raise self._typed(error) from error

    def _finger(self, call: Callable[[], bool]) -> bool:
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        self._latch.check()
        try:
            return bool(run_bounded(call, timeout_s=4 * _QUICK, stop=self._gripper.stop))
        except TimeoutError as error:
            raise GraspError("the fingers did not stop in time") from error
        except self._franky.NetworkException as error:
            raise ConnectionLost(f"{self.config.host}: {error}") from error
        except (self._franky.GripperException, *self._errors()) as error:
            raise GraspError(str(error)) from error
