"""The only robot that the rest of the package may hold: it checks every command before its backend.

A command that breaks a limit raises `SafetyViolation`, which names the limit; nothing is clamped,
and nothing has moved. Checked are the commanded way-points and everything between them, from where
the arm really stands. What is not checked: the elbow and the forearm (a hand that points down over
a flat table keeps them above it), other objects, and people. Software is no safety function: keep
the emergency stop in your hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TypeVar

import numpy as np

from warp_deform.errors import InputError

from .motion_checks import MotionChecks, Planner
from .panda_arm import GRIPPER_MAX_WIDTH, HOME_Q, PandaKinematics
from .robot import (
    HomesGripper,
    MotionError,
    MoveResult,
    ReflexError,
    Robot,
    RobotMode,
    RobotState,
    SafetyViolation,
    UserStopped,
    check_joints,
    check_pose,
    check_range,
)
from .safety_limits import SafetyLimits
from .straight_line import distance, straight_line

__all__ = ["SafeRobot"]

T = TypeVar("T")
# How far the robot's own pose may be from the nominal arm's: more means that another hand or
# another end effector is set in Desk, and the floor would be wrong by as much.
_MODEL_TOLERANCE = 3e-3, 0.02  # [m], [rad]
# How far a soft arm that presses may slide from its line [m].
_SLIDE = 6e-3
# Share of the stop force against the motion that tells a contact from a failed motion.
_PRESSING = 0.25
_HOME_STEP = 0.25  # [rad]
_MIN_HELD = 5e-4  # [m]: less than that between the fingers is nothing


class SafeRobot:
    """A `Robot` within `SafetyLimits`.

    Taking hold of a backend clears a reflex that is left from before, and moves nothing. Leaving
    the `with` block on an error, Ctrl-C included, stops the arm; the gripper keeps what it has.

    Args:
        robot: the backend; nobody else should command it from now on
        limits: what is let through
        home_q: joint positions of the home pose [rad]
        planner: inverse kinematics of straight lines; its answers are checked, not believed
        kinematics: the nominal arm

    Raises:
        UserStopped: the user stop is pressed
        ReflexError: the robot needs to be recovered by hand
        InputError: the home pose is beyond the limits
    """

    def __init__(
        self,
        robot: Robot,
        limits: SafetyLimits,
        *,
        home_q: Sequence[float] = HOME_Q,
        planner: Planner = straight_line,
        kinematics: PandaKinematics | None = None,
    ) -> None:
        self.limits = limits
        self._robot = robot
        self._arm = kinematics or PandaKinematics()
        self._checks = MotionChecks(limits, self._arm, planner=planner)
        self._home = check_joints(np.array(home_q))[0]
        self._recoveries = 0
        try:
            self._checks.check_way_points(self._home[None])
        except SafetyViolation as error:
            raise InputError(f"the home pose breaks the safety limits: {error}") from error
        robot.recover()

    # Reading.

    def state(self) -> RobotState:
        """Read the robot; see `Robot.state`.

        Raises:
            SafetyViolation: the reading is not finite, or its pose is not that of the nominal arm
        """
        state = self._robot.state()
        if not (np.isfinite(state.q).all() and np.isfinite(state.base_T_tcp).all()):
            raise SafetyViolation("the robot's reading is not finite", advice="restart the robot")
        off, turned = distance(self._arm.pose(state.q), state.base_T_tcp)
        if off > _MODEL_TOLERANCE[0] or turned > _MODEL_TOLERANCE[1]:
            raise SafetyViolation(
                f"end effector: the robot's TCP is {1e3 * off:.1f} mm and {turned:.3f} rad from "
                f"the Franka hand's (allowed: {1e3 * _MODEL_TOLERANCE[0]:g} mm, "
                f"{_MODEL_TOLERANCE[1]:g} rad)",
                advice="choose the Franka hand as the end effector in Desk",
            )
        return state

    # Moving.

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint way-points; see `Robot.move_joints`.

        It does not stop on contact, so it stays above `contact_height_m`.

        Raises:
            SafetyViolation: a limit is broken
            MotionError: the arm ended elsewhere
        """
        points = check_joints(q)
        self._checks.check_value("max_joint_speed", speed, self.limits.max_joint_speed)
        self._checks.check_joint_path(self._ready().q, points)
        self._command(lambda: self._robot.move_joints(points, speed=speed))
        self._check_arrival(self._arm.pose(points[-1]))

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`.

        Raises:
            SafetyViolation: a limit is broken
            UnreachablePose: no joint positions lead there
            MotionError: the arm ended elsewhere, and not because of a contact
        """
        target = check_pose(base_T_tcp)
        state = self._ready()
        self._checks.check_line(
            state.q, state.base_T_tcp, target, speed=speed, stop_force_N=stop_force_N
        )
        try:
            result = self._command(
                lambda: self._robot.move_linear(target, speed=speed, stop_force_N=stop_force_N)
            )
            if not result.contact:
                self._check_arrival(target)
        except MotionError as error:
            pressed = self._pressed(state.base_T_tcp, target, stop_force_N or np.inf)
            # A reflex or the user stop is a MotionError of a narrower kind, and no contact.
            if type(error) is not MotionError or pressed is None:
                raise
            return pressed
        return result

    def check_lines(
        self, lines: Sequence[tuple[np.ndarray, float, float | None]]
    ) -> list[np.ndarray]:
        """Check straight lines one after another from here, and move nothing.

        Args:
            lines: target pose, speed and stop force of each, as `move_linear` takes them

        Returns:
            the joint positions at the end of each [rad], (7,)

        Raises:
            SafetyViolation, UnreachablePose: one of them would be refused
        """
        state = self._ready()
        q, pose = state.q, state.base_T_tcp
        ends = []
        for target, speed, force in lines:
            target = check_pose(target)
            q = self._checks.check_line(q, pose, target, speed=speed, stop_force_N=force)
            pose = target
            ends.append(q)
        return ends

    def home(self, *, speed: float | None = None) -> None:
        """Move to the home pose: straight up to `contact_height_m` if lower, then in joint space.

        Args:
            speed: share of the joints' greatest speeds; default: as fast as the limits allow

        Raises:
            SafetyViolation, UnreachablePose, MotionError: see `move_joints`
        """
        state = self._ready()
        rise = self.limits.contact_height_m - float(self.limits.height(state.base_T_tcp))
        if rise > 0.0:
            above = state.base_T_tcp.copy()
            # A millimetre more: the arm may end a little short, and the next motion must start
            # above the limit.
            above[2, 3] += rise + 1e-3
            self.move_linear(_orthonormal(above), speed=self.limits.max_speed)
            state = self._ready()
        count = max(int(np.ceil(np.abs(self._home - state.q).max() / _HOME_STEP)), 1)
        points = state.q + np.arange(1, count + 1)[:, None] / count * (self._home - state.q)
        points[-1] = self._home
        # A start within a joint's margin is allowed, way-points there are not.
        outside = (points < self.limits.q_min) | (points > self.limits.q_max)
        kept = points[int(np.argmin(outside.any(axis=1))) :]
        self.move_joints(kept, speed=speed or self.limits.max_joint_speed)

    def stands_at(self, q: np.ndarray) -> bool:
        """Whether the TCP is where joint positions q (7,) [rad] put it, as near as an arrival."""
        off, turned = distance(self.state().base_T_tcp, self._arm.pose(np.asarray(q)))
        limits = self.limits
        return off <= limits.arrival_tolerance_m and turned <= limits.arrival_tolerance_rad

    # The gripper.

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        self._command(lambda: self._robot.open_gripper(width_m))

    def home_gripper(self) -> bool:
        """Let the fingers find their zero; False where this backend cannot, see `HomesGripper`."""
        backend = self._robot
        if not isinstance(backend, HomesGripper):
            return False
        self._command(backend.home_gripper)
        return True

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; returns whether both the backend and the measured width say "held".

        Raises:
            SafetyViolation: more force than `max_grasp_force_N`
        """
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        limit = self.limits.max_grasp_force_N
        self._checks.check_value("max_grasp_force_N", force_N, limit, " N")
        held = self._command(lambda: self._robot.grasp(width_m=width_m, force_N=force_N))
        return held and self.holds()

    def holds(self) -> bool:
        """Whether the fingers have something between them, by their measured opening."""
        return self.state().gripper_width_m > _MIN_HELD

    # The rest of the protocol.

    def stop(self) -> None:
        """End the motion in progress; see `Robot.stop`."""
        self._robot.stop()

    def recover(self, *, confirmed: bool = False) -> None:
        """Clear a reflex; see `Robot.recover`.

        Args:
            confirmed: whether an operator has looked at the arm; then it does not count

        Raises:
            SafetyViolation: it was done `max_recoveries` times since `begin_episode`, unconfirmed
            UserStopped: the user stop is pressed: that takes an operator
        """
        if self._robot.state().mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if confirmed:
            self._robot.recover()
            return
        if self._recoveries >= self.limits.max_recoveries:
            raise SafetyViolation(
                f"max_recoveries: {self._recoveries} in this episode, "
                f"{self.limits.max_recoveries} allowed",
                advice="have an operator look at the arm, then begin a new episode",
            )
        self._recoveries += 1
        self._robot.recover()

    def begin_episode(self) -> None:
        """Count recoveries without an operator from zero."""
        self._recoveries = 0

    def close(self) -> None:
        """End the connection; see `Robot.close`."""
        self._robot.close()

    def __enter__(self) -> SafeRobot:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is not None:
                self._robot.stop()
        finally:
            self._robot.close()

    def _ready(self) -> RobotState:
        """Return the state of a robot that stands still and within the limits."""
        state = self.state()
        if state.mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if state.mode == RobotMode.REFLEX:
            raise ReflexError("the robot stands in a reflex")
        if state.mode != RobotMode.IDLE:
            raise MotionError(
                f"the robot is in mode {state.mode.value} and accepts no motion",
                advice="let go of the guiding button, end other programs that have the arm, then "
                "press Enter, or start the command again",
            )
        self._checks.check_start(state.base_T_tcp)
        return state

    def _pressed(
        self, start: np.ndarray, target: np.ndarray, stop_force_N: float
    ) -> MoveResult | None:
        """Return a contact where the hand ended short of `target`, on its line, pressing.

        The arm's controller is soft: a surface a few millimetres above the target holds it with
        less than the stop force. That is the contact that was looked for.
        """
        state = self.state()
        line = target[:3, 3] - start[:3, 3]
        length = max(float(np.linalg.norm(line)), 1e-9)
        done = float((state.base_T_tcp[:3, 3] - start[:3, 3]) @ line) / length
        aside = np.linalg.norm(state.base_T_tcp[:3, 3] - start[:3, 3] - done * line / length)
        force = -float(state.force_N[:3] @ line) / length
        on_line = 0.0 <= done <= length and aside <= _SLIDE
        if state.mode != RobotMode.IDLE or not on_line or force < _PRESSING * stop_force_N:
            return None
        return MoveResult(state.base_T_tcp, contact=True)

    def _command(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except KeyboardInterrupt:
            self._robot.stop()
            raise

    def _check_arrival(self, target: np.ndarray) -> None:
        off, turned = distance(self.state().base_T_tcp, target)
        tolerance = self.limits.arrival_tolerance_m, self.limits.arrival_tolerance_rad
        if off > tolerance[0] or turned > tolerance[1]:
            raise MotionError(
                f"the TCP ended {1e3 * off:.1f} mm and {turned:.3f} rad from its target "
                f"(allowed: {1e3 * tolerance[0]:.1f} mm, {tolerance[1]:.3f} rad)"
            )


def _orthonormal(base_T_tcp: np.ndarray) -> np.ndarray:
    """Return a measured pose with its rotation made exact."""
    u, _, v = np.linalg.svd(base_T_tcp[:3, :3])
    exact = base_T_tcp.copy()
    exact[:3, :3] = u @ v
    exact[3] = 0.0, 0.0, 0.0, 1.0
    return exact
