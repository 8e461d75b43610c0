"""A Panda through frankapy, ROS and a control PC: for labs whose robots already run that way.

frankapy swallows errors unless told otherwise, does not say whether a grasp holds, and its
gripper call returns before the fingers stand. Here every motion is made with
`ignore_errors=False`, its arrival is measured, and the fingers are watched until they stand.
It has no call that clears a reflex: franka-interface does that itself. It waits without end for the
control PC's servers; here they are looked for first, within a limit.

Never run on a physical robot by the authors; tested against a stand-in for frankapy. Stopping by
software is no safety function.

Source: iamlab-cmu/frankapy, `franka_arm.py` and `franka_arm_state_client.py`.
"""

from __future__ import annotations

import functools
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from ..arm.arguments import check_joints, check_line, check_range
from ..arm.arrival import check_arrival, check_joints_arrival, has_arrived
from ..arm.panda import DQ_MAX, GRIPPER_MAX_WIDTH
from ..arm.robot import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    GraspError,
    MotionError,
    MoveResult,
    RobotError,
    RobotMode,
    RobotState,
    UnreachablePose,
)
from ..arm.stop_latch import StopLatch
from ..arm.straight_line import distance
from ..support.bounded import run_bounded
from ..support.closing import Closing
from .franka_config import FrankaConfig
from .libfranka_errors import typed_error

__all__ = ["FrankapyConfig", "FrankapyRobot"]

T = TypeVar("T")
_PEAK = 1.875
"""Greatest over mean speed of a minimum-jerk motion."""
_TURN_SPEED = 0.5  # [rad/s]
_SHORTEST = 0.5  # [s]
_STANDS = 2e-4  # [m] between two looks at fingers that stand
_POLL = 0.1  # [s]
# What FrankaArm() waits for, by number of the robot: ROS services, and actions with their topics.
_SERVICES = (
    "/get_current_robot_state_server_node_{}/get_current_robot_state_server",
    "/get_current_franka_interface_status_server_node_{}/get_current_franka_interface_status_server",
)
_ACTIONS = (
    "/execute_skill_action_server_node_{}/execute_skill",
    "/franka_gripper_{}/homing",
    "/franka_gripper_{}/move",
    "/franka_gripper_{}/grasp",
)


@dataclass(frozen=True, kw_only=True)
class FrankapyConfig(FrankaConfig):
    """The same; the robot's address stands in frankapy's own configuration."""

    robot_num: int = 1
    """Number of the robot on the control PC."""
    connect_timeout_s: float = 10.0
    """Longest wait for the control PC's servers [s]."""
    gripper_timeout_s: float = 5.0
    """Longest wait for the fingers to stand [s]."""


class FrankapyRobot(Closing):
    """A `Robot` over `frankapy.FrankaArm`. Connecting moves nothing.

    Args:
        config: what to expect
        sleep: waits [s]
        say: takes a line about what is still being waited for; default: prints it on stderr

    Raises:
        BackendMissing: frankapy or ROS 1 is not installed
        ConnectionFailed: the control PC does not answer, or the robot is not ready
    """

    def __init__(
        self,
        config: FrankapyConfig | None = None,
        *,
        sleep: Callable[[float], None] = time.sleep,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.config = config or FrankapyConfig()
        self._say = say or (lambda line: print(line, file=sys.stderr, flush=True))
        self._sleep = sleep
        self._closed = False
        self._latch = StopLatch()
        try:
            import frankapy
            import rospy
            from autolab_core import RigidTransform
            from frankapy import exceptions
        except ImportError as error:
            raise BackendMissing(
                f"frankapy cannot be loaded: {error}",
                advice="source the ROS workspace of frankapy, or use --robot panda, without ROS",
            ) from error
        self._transform = RigidTransform
        self._exceptions = exceptions
        self._find_servers(rospy)
        # FrankaArm makes Ctrl-C leave the process at once; here it has to stop the arm first.
        handler = signal.getsignal(signal.SIGINT)
        try:
            self._arm: Any = frankapy.FrankaArm(robot_num=self.config.robot_num)
        except (
            exceptions.FrankaArmCommException,
            exceptions.FrankaArmFrankaInterfaceNotReadyException,
            exceptions.FrankaArmException,
        ) as error:
            raise ConnectionFailed(
                f"frankapy: {error}", advice="start the control PC and franka-interface, then retry"
            ) from error
        finally:
            signal.signal(signal.SIGINT, handler)

    def _find_servers(self, rospy: Any) -> None:
        """Return once everything is there that FrankaArm() would wait for without end."""
        until = time.monotonic() + self.config.connect_timeout_s

        def left() -> float:
            return max(until - time.monotonic(), _POLL)

        def published(topic: str) -> None:
            while topic not in {name for name, _ in rospy.get_published_topics()}:
                if time.monotonic() > until:
                    raise TimeoutError
                time.sleep(_POLL)

        n = self.config.robot_num
        for service in (name.format(n) for name in _SERVICES):
            self._wait(service, functools.partial(rospy.wait_for_service, service, left()), rospy)
        for action in (name.format(n) for name in _ACTIONS):
            self._wait(action, functools.partial(published, f"{action}/status"), rospy)

    def _wait(self, server: str, wait: Callable[[], None], rospy: Any) -> None:
        limit = self.config.connect_timeout_s
        messages: list[str] = []

        def tell() -> None:
            if not messages:
                messages.append(f"frankapy: waiting up to {limit:g} s for {server}")
                self._say(messages[0])

        try:
            # In a thread: the name server itself may be a machine that does not answer.
            run_bounded(wait, timeout_s=limit + 1.0, watch=tell)
        except (TimeoutError, OSError, rospy.ROSException) as error:
            raise ConnectionFailed(
                f"frankapy: {server} is not there after {limit:g} s",
                advice="start roscore, and franka-interface with its gripper on the control PC; "
                "see that ROS_MASTER_URI and ROS_IP name the right machines",
            ) from error

    def state(self) -> RobotState:
        """Read the robot now; see `Robot.state`.

        frankapy does not tell the robot's mode: it is "moving" while a skill runs, else "idle".
        """
        arm = self._arm
        pose = self._call(arm.get_pose)
        base_T_tcp = np.eye(4)
        base_T_tcp[:3, :3], base_T_tcp[:3, 3] = pose.rotation, pose.translation
        done = self._call(lambda: arm.is_skill_done(ignore_errors=False))
        return RobotState(
            q=np.array(self._call(arm.get_joints), dtype=float),
            base_T_tcp=base_T_tcp,
            force_N=np.array(self._call(arm.get_ee_force_torque), dtype=float),
            gripper_width_m=float(self._call(arm.get_gripper_width)),
            mode=RobotMode.IDLE if done else RobotMode.MOVING,
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint waypoints; see `Robot.move_joints`. The arm rests at each."""
        points = check_joints(q)
        check_range("speed", speed, low=0.0, high=1.0, unit="of the greatest speed")
        for start, end in pairwise([self.state().q, *points]):
            self._joint_skill(start, end, speed)
        check_joints_arrival(self.config, self.state().q, points[-1])

    def _joint_skill(self, start: np.ndarray, end: np.ndarray, speed: float) -> None:
        """Go from `start` to `end` (7,) [rad], no joint faster than its share of its speed."""
        seconds = _PEAK * float((np.abs(end - start) / (speed * DQ_MAX)).max())
        self._skill(
            lambda: self._arm.goto_joints(
                end.tolist(),
                duration=max(seconds, _SHORTEST),
                use_impedance=False,
                block=True,
                ignore_errors=False,
            )
        )

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`."""
        high = self.config.collision_force_N
        target = check_line(base_T_tcp, speed=speed, stop_force_N=stop_force_N, most_force_N=high)
        limits = None
        if stop_force_N is not None:
            # torques are not what a descent should feel
            limits = [stop_force_N] * 3 + [high] * 3
        far, turned = distance(self.state().base_T_tcp, target)
        seconds = _PEAK * max(far / speed, turned / _TURN_SPEED)
        pose = self._transform(
            rotation=target[:3, :3],
            translation=target[:3, 3],
            from_frame="franka_tool",
            to_frame="world",
        )
        self._skill(
            lambda: self._arm.goto_pose(
                pose,
                duration=max(seconds, _SHORTEST),
                use_impedance=False,
                force_thresholds=limits,
                block=True,
                ignore_errors=False,
            )
        )
        state = self.state()
        # frankapy does not say that a threshold ended the skill: the force, still there, does.
        pressing = stop_force_N is not None and (
            float(np.abs(state.force_N[:3]).max()) > 0.5 * stop_force_N
        )
        if pressing and not has_arrived(self.config, state.base_T_tcp, target):
            return MoveResult(state.base_T_tcp, contact=True)
        check_arrival(self.config, state.base_T_tcp, target)
        return MoveResult(state.base_T_tcp, contact=False)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        self._latch.check()
        self._call(
            lambda: self._arm.goto_gripper(
                width_m, grasp=False, speed=self.config.gripper_speed, block=True
            )
        )
        reached = self._standing_width()
        if abs(reached - width_m) > self.config.held_tolerance_m:
            raise GraspError(f"the fingers stand at {reached:.4f} m, not at {width_m} m")

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        self._latch.check()
        self._call(
            lambda: self._arm.goto_gripper(
                width_m,
                grasp=True,
                speed=self.config.gripper_speed,
                force=force_N,
                epsilon_inner=GRIPPER_MAX_WIDTH,
                epsilon_outer=GRIPPER_MAX_WIDTH,
                block=True,
            )
        )
        reached = self._standing_width()
        return self.config.min_held_m < reached <= width_m + self.config.held_tolerance_m

    def stop(self) -> None:
        """End the motion in progress, and let none begin until `recover`; see `Robot.stop`."""
        self._latch.stop(lambda: self._call(self._arm.stop_skill))

    def recover(self) -> None:
        """End what runs; franka-interface recovers from a reflex by itself; see `Robot.recover`."""
        mark = self._latch.mark()
        if self.state().mode is not RobotMode.IDLE:
            self._call(self._arm.stop_skill)
        if self.state().mode is not RobotMode.IDLE:
            raise MotionError(
                "a skill still runs after it was stopped", advice="restart franka-interface"
            )
        self._latch.release(mark)

    def close(self) -> None:
        """Accept nothing more; frankapy has nothing to close."""
        self._closed = True

    def _standing_width(self) -> float:
        """The opening once the fingers stand [m]: frankapy's own wait ends too early."""
        before = float(self._call(self._arm.get_gripper_width))
        for _ in range(max(int(self.config.gripper_timeout_s / _POLL), 1)):
            self._sleep(_POLL)
            now = float(self._call(self._arm.get_gripper_width))
            if abs(now - before) < _STANDS:
                return now
            before = now
        raise GraspError("the fingers did not stand in time")

    def _skill(self, motion: Callable[[], Any]) -> None:
        try:
            with self._latch.motion():
                self._call(motion)
                if self._latch.pressed:
                    raise MotionError("the motion was stopped")
        except KeyboardInterrupt:
            self.stop()
            raise

    def _call(self, call: Callable[[], T]) -> T:
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        known = self._exceptions
        try:
            return call()
        except known.FrankaArmCommException as error:
            raise ConnectionLost(f"frankapy: {error}") from error
        except known.FrankaArmFrankaInterfaceNotReadyException as error:
            raise ConnectionLost(
                f"franka-interface is not ready: {error}", advice="restart it on the control PC"
            ) from error
        except known.FrankaArmException as error:
            raise self._typed(str(error)) from error
        except ValueError as error:  # its joint limits and virtual walls
            raise UnreachablePose(f"frankapy refuses the target: {error}") from error

    @staticmethod
    def _typed(message: str) -> RobotError:
        return typed_error(message, host="frankapy")
