"""The only robot that the rest of the package may hold: it checks every command before its backend.

A command that breaks a limit raises `SafetyViolation`, which names the limit, and nothing has
moved; one that is malformed raises `InputError`. Nothing is clamped but speed: where the way would
take the hand beyond its own speeds the motion is made slower, and its result says so. Checked are
copies of the commanded waypoints and everything between them, from where the arm really stands.
What is not checked: the elbow and the forearm (a hand that points down over a flat table keeps them
above it), other objects, and people. Software is no safety function: keep the emergency stop in
your hand.

One thread at a time commands; check and motion are one. `stop` waits for nobody and holds: nothing
moves after it until `recover`. Limits and home pose are fixed once the robot is held.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from warp_deform.errors import InputError

from ..support.closing import Closing
from .arguments import check_joints, check_pose, check_range, shown
from .arrival import check_arrival, has_arrived, pressed_contact
from .home_path import home_waypoints, pose_above
from .limits import SafetyLimits
from .motion_checks import LineSolver, MotionChecks, as_lines
from .panda import GRIPPER_MAX_WIDTH, HOME_Q, PandaKinematics
from .robot import (
    HomesGripper,
    JointMoveResult,
    MotionError,
    MoveResult,
    ReflexError,
    Robot,
    RobotMode,
    RobotState,
    SafetyViolation,
    UserStopped,
)
from .sinking import Sinking
from .stop_latch import StopLatch
from .straight_line import straight_line

__all__ = ["SafeRobot"]

T = TypeVar("T")
_MIN_HELD = 5e-4  # [m]: less than that between the fingers is nothing
_MIN_WIDTH = 1e-5  # [m]: less is a slip
_FIXED = frozenset({"_arm", "_checks", "_home", "_latch", "_limits", "_lock", "_robot", "_sinking"})


class SafeRobot(Closing):
    """A `Robot` within `SafetyLimits`.

    Taking hold of a backend clears a reflex that is left from before, and moves nothing. Leaving
    the `with` block on an error, Ctrl-C included, stops the arm; the gripper keeps what it has.
    What an attribute was made with stays: assigning another raises AttributeError.

    Args:
        robot: the backend; nobody else should command it from now on
        limits: what is let through
        home_q: joint positions of the home pose [rad]
        line_solver: inverse kinematics of straight lines; its answers are checked, not believed
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
        line_solver: LineSolver = straight_line,
        kinematics: PandaKinematics | None = None,
    ) -> None:
        if not isinstance(limits, SafetyLimits):
            raise InputError(f"limits: SafetyLimits are needed, not {shown(limits)}")
        self._limits = limits
        self._robot = robot
        self._lock = threading.RLock()
        self._latch = StopLatch()
        self._arm = kinematics or PandaKinematics()
        self._checks = MotionChecks(limits, self._arm, line_solver)
        self._home = check_joints(home_q)[0]
        self._home.flags.writeable = False
        self._recoveries = 0
        self._sinking = Sinking(limits)
        try:
            self._checks.check_waypoints(self._home[None])
        except SafetyViolation as error:
            raise InputError(f"the home pose breaks the safety limits: {error}") from error
        robot.recover()

    def __setattr__(self, name: str, value: object) -> None:
        if name in _FIXED and name in self.__dict__:
            raise AttributeError(f"{name} is fixed once the robot is held; make another SafeRobot")
        super().__setattr__(name, value)

    # Reading.

    @property
    def limits(self) -> SafetyLimits:
        """What is let through."""
        return self._limits

    def state(self) -> RobotState:
        """Read the robot; see `Robot.state`.

        Raises:
            SafetyViolation: the reading is not finite, or its pose is not that of the nominal arm
        """
        state = self._robot.state()
        self._checks.check_reading(state)
        return state

    # Moving.

    def move_joints(self, q: np.ndarray, *, speed: float) -> JointMoveResult:
        """Move through joint waypoints; see `Robot.move_joints`.

        It does not stop on contact, so it stays above `contact_height_m`. It is made slower than
        commanded where the TCP would exceed its speeds or turn by more than 0.5 rad/s on the way.

        Raises:
            InputError: no joint positions, or a speed that is no number
            SafetyViolation: a limit is broken
            MotionError: the arm ended elsewhere, or `stop` holds
        """
        points = check_joints(q)
        with self._lock:
            before = self._ready()
            path = self._checks.check_joint_path(before.q, points, speed=speed)
            self._move(
                before,
                lambda: self._robot.move_joints(path.points.copy(), speed=path.speed),
                stops=False,
            )
            self._check_arrival(self._arm.pose(points[-1]))
            return JointMoveResult(path.speed, slowed=path.speed < speed)

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP in a straight line; see `Robot.move_linear`.

        Raises:
            InputError: no pose, or a speed or force that is no number
            SafetyViolation: a limit is broken
            UnreachablePose: no joint positions lead there
            MotionError: the arm ended elsewhere, and not because of a contact; or `stop` holds
        """
        target = check_pose(base_T_tcp)
        with self._lock:
            state = self._ready()
            line = self._checks.check_line(
                state.q,
                state.base_T_tcp,
                target,
                speed=speed,
                stop_force_N=stop_force_N,
                sunk=self._sinking.sunk_m,
            )
            try:
                result = self._move(
                    state,
                    lambda: self._robot.move_linear(
                        target.copy(), speed=line.speed, stop_force_N=stop_force_N
                    ),
                    stops=stop_force_N is not None,
                )
                if not result.contact:
                    self._check_arrival(target)
            except MotionError as error:
                # A reflex or the user stop is a MotionError of a narrower kind, and no contact.
                if type(error) is not MotionError or stop_force_N is None:
                    raise
                pressed = pressed_contact(self.state(), state.base_T_tcp, target, stop_force_N)
                if pressed is None:
                    raise
                result = pressed
            return replace(result, slowed_to=line.speed) if line.speed < speed else result

    def check_lines(
        self, lines: Sequence[tuple[np.ndarray, float, float | None]]
    ) -> list[np.ndarray]:
        """Check straight lines one after another from here, and move nothing.

        Args:
            lines: target pose, speed and stop force of each, as `move_linear` takes them

        Returns:
            the joint positions at the end of each [rad], (7,)

        Raises:
            SafetyViolation, UnreachablePose, InputError: one of them would be refused
        """
        triples = as_lines(lines)
        with self._lock:
            state = self._ready()
            q, pose, sunk = state.q, state.base_T_tcp, self._sinking.sunk_m
            ends = []
            for target, speed, force in triples:
                line = self._checks.check_line(
                    q, pose, target, speed=speed, stop_force_N=force, sunk=sunk
                )
                q, pose, sunk = line.q, target, line.sunk
                ends.append(q)
            return ends

    def home(self, *, speed: float | None = None) -> JointMoveResult:
        """Move to the home pose: straight up to `contact_height_m` if lower, then in joint space.

        Args:
            speed: share of the joints' greatest speeds; default: as fast as the limits allow

        Raises:
            SafetyViolation, UnreachablePose, MotionError, InputError: see `move_joints`
        """
        limits = self.limits
        share = limits.max_joint_speed if speed is None else self._checks.check_share(speed)
        with self._lock:
            state = self._ready()
            above = pose_above(limits, state.base_T_tcp)
            if above is not None:
                self.move_linear(above, speed=limits.max_speed)
                state = self._ready()
            return self.move_joints(home_waypoints(limits, state.q, self._home), speed=share)

    def stands_at(self, q: np.ndarray) -> bool:
        """Whether the TCP is where joint positions q (7,) [rad] put it, as near as an arrival."""
        target = self._arm.pose(check_joints(q)[0])
        return has_arrived(self.limits, self.state().base_T_tcp, target)

    # The gripper.

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`.

        Raises:
            InputError: no width
            MotionError: `stop` holds
        """
        width = check_range("width_m", width_m, low=_MIN_WIDTH, high=GRIPPER_MAX_WIDTH, unit="m")
        self._fingers(lambda: self._robot.open_gripper(width))

    def home_gripper(self) -> bool:
        """Let the fingers find their zero; False where this backend cannot, see `HomesGripper`."""
        backend = self._robot
        if not isinstance(backend, HomesGripper):
            return False
        self._fingers(backend.home_gripper)
        return True

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; returns whether both the backend and the measured width say "held".

        Raises:
            SafetyViolation: more force than `max_grasp_force_N`
            InputError: no width or force
            MotionError: `stop` holds
        """
        width = check_range("width_m", width_m, low=_MIN_WIDTH, high=GRIPPER_MAX_WIDTH, unit="m")
        force = self._checks.check_grasp_force(force_N)
        held = self._fingers(lambda: self._robot.grasp(width_m=width, force_N=force))
        return held and self.holds()

    def holds(self) -> bool:
        """Whether the fingers have something between them, by their measured opening."""
        return self.state().gripper_width_m > _MIN_HELD

    # The rest of the protocol.

    def stop(self) -> None:
        """End the motion in progress, and let none begin until `recover`; from any thread.

        It holds also between the check of a motion and its start, and without the backend's answer.
        """
        self._latch.stop(self._robot.stop)

    def recover(self, *, confirmed: bool = False) -> None:
        """Clear a reflex, and a `stop` that came before this call; see `Robot.recover`.

        It waits until a motion of another thread has ended.

        Args:
            confirmed: whether an operator has looked at the arm; then it does not count

        Raises:
            SafetyViolation: it was done `max_recoveries` times since `begin_episode`, unconfirmed
            UserStopped: the user stop is pressed: that takes an operator
        """
        if not isinstance(confirmed, bool):
            raise InputError(f"confirmed: True or False, not {shown(confirmed)}")
        with self._lock:
            mark = self._latch.mark()
            if self._robot.state().mode == RobotMode.USER_STOPPED:
                raise UserStopped("the user stop is pressed")
            if not confirmed:
                if self._recoveries >= self.limits.max_recoveries:
                    raise SafetyViolation(
                        f"max_recoveries: {self._recoveries} in this episode, "
                        f"{self.limits.max_recoveries} allowed",
                        advice="have an operator look at the arm, then begin a new episode",
                    )
                self._recoveries += 1
            self._robot.recover()
            self._latch.release(mark)

    def begin_episode(self) -> None:
        """Count recoveries without an operator from zero."""
        self._recoveries = 0

    def close(self) -> None:
        """End the connection; see `Robot.close`."""
        self._robot.close()

    def _end_by(self, error: BaseException) -> None:
        self.stop()

    def _ready(self) -> RobotState:
        """Return the state of a robot that stands still and within the limits, not stopped."""
        state = self.state()
        self._latch.check()
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

    def _move(self, before: RobotState, call: Callable[[], T], *, stops: bool) -> T:
        """Have the backend move the arm, and measure how far the hand has sunk without a stop.

        Args:
            before: the reading before the motion
            call: the backend's motion
            stops: whether it stops on contact
        """
        with self._sinking.measured(self._robot, before.base_T_tcp, stops=stops):
            try:
                with self._latch.motion():
                    return call()
            except KeyboardInterrupt:
                self.stop()
                raise

    def _fingers(self, call: Callable[[], T]) -> T:
        """Have the backend move the fingers; a stop ends no motion of theirs, but prevents one."""
        with self._lock:
            self._latch.check()
            try:
                return call()
            except KeyboardInterrupt:
                self.stop()
                raise

    def _check_arrival(self, target: np.ndarray) -> None:
        check_arrival(self.limits, self.state().base_T_tcp, target)
