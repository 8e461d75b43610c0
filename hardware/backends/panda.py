"""The Franka Panda (FER) through panda-python: libfranka 0.9, server version 5, no ROS.

Motions go through joint waypoints, because the vendor's Cartesian controller stops millimetres
short. Straight lines are solved on the robot's own kinematic model.

Never run on a physical robot by the authors: tested with the vendor's wheel against
`hardware.emulator`. Stopping by software is no safety function; keep the user stop in your hand.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..arm.arguments import check_joints, check_line, check_range
from ..arm.arrival import check_arrival
from ..arm.joint_path import path_pieces
from ..arm.panda import GRIPPER_MAX_WIDTH
from ..arm.robot import (
    GraspError,
    MotionError,
    MoveResult,
    ReflexError,
    RobotMode,
    RobotState,
    UserStopped,
)
from ..arm.straight_line import straight_line
from ..support.closing import Closing
from .franka_config import RECOVERY_TIMEOUT, NetworkedConfig
from .libfranka_errors import reflex_names
from .panda_link import BUSY, PandaLink

__all__ = ["PandaRobot"]

# A reading while the vendor plans keeps a motion from starting: where that happens it is tried
# again so often.
STARTS = 5
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
    until recover(). After a user stop that was released the state says nothing, yet motions are
    refused: call recover() once after connecting, as `SafeRobot` does. state() and stop() may be
    called from other threads while the arm moves.

    Raises:
        BackendMissing: panda-python is not installed
        IncompatibleVersion: the robot is no Panda of system version 4.2 or later
        ConnectionFailed: nothing answers, FCI is not active, or another client has it
    """

    def __init__(self, config: NetworkedConfig | None = None) -> None:
        self.config = config or NetworkedConfig()
        check_range("collision_force_N", self.config.collision_force_N, low=0, high=100, unit="N")
        self._thresholds_set = False
        self._link = PandaLink(self.config)

    def pose(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (4, 4) [m] of joint positions [rad] (7,), by the robot's own model."""
        return self._link.pose(q)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the TCP's Jacobian in the base frame (6, 7), by the robot's own model."""
        return self._link.jacobian(q)

    # The protocol.

    def state(self) -> RobotState:
        """Read the robot now; see `Robot.state`."""
        reading = self._link.read()
        return RobotState(
            q=np.array(reading.q),
            base_T_tcp=np.array(reading.O_T_EE).reshape(4, 4).T,
            force_N=np.array(reading.O_F_ext_hat_K),
            gripper_width_m=self._link.width(),
            mode=MODES.get(reading.robot_mode.name, RobotMode.OTHER),
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint waypoints; see `Robot.move_joints`.

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
        high = self.config.collision_force_N
        target = check_line(base_T_tcp, speed=speed, stop_force_N=stop_force_N, most_force_N=high)
        plan = straight_line(self, np.array(self._ready().q), target, speed=speed)
        contact = False
        if stop_force_N is None:
            self._move(plan.q, plan.speed_factor, target)
        else:
            contact = self._move_until(stop_force_N, plan.q, plan.speed_factor, target)
        return MoveResult(np.array(self._link.read().O_T_EE).reshape(4, 4).T, contact)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        if not self._link.finger(lambda hand: hand.move(width_m, self.config.gripper_speed)):
            raise GraspError(f"the fingers did not open to {width_m} m")

    def home_gripper(self) -> None:
        """Close and open the fingers to find their zero; needed once after the hand was powered.

        Raises:
            GraspError: they did not get through
        """
        if not self._link.finger(lambda hand: hand.homing()):
            raise GraspError("the fingers could not be homed")

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        speed = self.config.gripper_speed
        self._link.finger(lambda hand: hand.grasp(width_m, speed, force_N, WIDE, WIDE))
        width = self._link.width()
        return self.config.min_held_m < width <= width_m + self.config.held_tolerance_m

    def stop(self) -> None:
        """End the motion in progress; see `Robot.stop`."""
        self._link.stop()

    def recover(self) -> None:
        """Have the robot recover; see `Robot.recover`.

        It takes up to some ten seconds, during which Python's threads stand still.
        """
        mark = self._link.latch.mark()
        mode = self._mode(self._link.read())
        if mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if mode in (RobotMode.MOVING, RobotMode.GUIDING):
            raise ReflexError(
                f"the robot is in mode {mode.value}", advice="let it come to rest, then try again"
            )
        # Also where the state looks right: a user stop that was released does not show there.
        self._clear()
        reading = self._link.read()
        mode = self._mode(reading)
        by_hand = "recover it by hand in Desk"
        if mode != RobotMode.IDLE:
            what = f"the robot is still in mode {mode.value} after recovery"
            raise ReflexError(what, advice=by_hand)
        if reading.current_errors:
            raise self._errors(reading, advice=by_hand)
        self._set_collision_force(self.config.collision_force_N)
        self._link.latch.release(mark)

    def close(self) -> None:
        """End the connection; see `Robot.close`."""
        self._link.close()

    def _clear(self) -> None:
        self._link.command(
            lambda robot: robot.automatic_error_recovery(), timeout_s=RECOVERY_TIMEOUT
        )

    @staticmethod
    def _errors(reading: Any, *, advice: str | None = None) -> ReflexError:
        names = reflex_names(str(reading.current_errors))
        return ReflexError(f"the robot reports {', '.join(names)}", reflexes=names, advice=advice)

    @staticmethod
    def _mode(reading: Any) -> RobotMode:
        return MODES.get(reading.robot_mode.name, RobotMode.OTHER)

    def _ready(self) -> Any:
        """Return a fresh state of a robot that accepts motions.

        The vendor recovers from a reflex by itself before a motion, without a word; here that takes
        a call to recover().
        """
        reading = self._link.read()
        self._link.latch.check()
        mode = self._mode(reading)
        if mode == RobotMode.USER_STOPPED:
            raise UserStopped("the user stop is pressed")
        if mode == RobotMode.REFLEX:
            reflexes = reflex_names(str(reading.last_motion_errors))
            raise ReflexError(f"the robot stands in a reflex: {reflexes}", reflexes=reflexes)
        if reading.current_errors:
            raise self._errors(reading)
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
                if self._link.latch.pressed:
                    raise MotionError("the motion was stopped before its last waypoint")
                try:
                    self._link.follow(begin, piece, factor)
                    break
                except MotionError as error:
                    if BUSY not in str(error) or not left:
                        raise
        reached = np.array(self._link.read().O_T_EE).reshape(4, 4).T
        check_arrival(self.config, reached, target)

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
            self._clear()
            return True
        finally:
            if self._mode(self._link.read()) == RobotMode.IDLE:
                self._set_collision_force(self.config.collision_force_N)
        return False

    def _set_collision_force(self, force: float) -> None:
        """Make the robot stop itself at a force on the hand [N]; contact is reported at half."""
        torque = [self.config.collision_torque_Nm] * 7
        # Torques on the hand keep their threshold: the force is what a descent should feel.
        forces = [force] * 3 + [self.config.collision_force_N] * 3
        self._link.command(
            lambda robot: robot.set_collision_behavior(
                [0.5 * t for t in torque], torque, [0.5 * f for f in forces], forces
            )
        )
        self._thresholds_set = True
