"""The emulated arm: joint state, the four motion generators, torque control, and their limits.

Motion generators are followed exactly. Torques accelerate joints of constant, diagonal inertia with
a little viscous friction; contact pushes back through the Jacobian. A violated limit stops the arm
at once and is returned by the names that libfranka prints. Where a command is missing, the motion
generator's goes on at its last acceleration and the last torques stay.
"""

from __future__ import annotations

import numpy as np

from warp_deform.errors import InputError

from ..arm.panda import DQ_MAX, Q_MAX, Q_MIN, flange_T_tcp
from .frames import difference, is_frame, moved_on
from .model_library import INERTIA, ModelLibrary
from .motion_limits import (
    DT,
    elbow_excess,
    excess_at_end,
    joint_excess,
    torque_excess,
    twist_excess,
)
from .protocol import ROBOT_COMMAND, ControllerMode, GeneratorMode

__all__ = ["ELBOW_SIGN", "Arm"]

# What rounding may add to a measured velocity before it counts as too much.
SLACK = 1.001
FRICTION = 0.5  # [N m s/rad]
# As arrays that are not made anew every millisecond.
_INERTIA, _DQ_GREATEST = np.array(INERTIA), DQ_MAX * SLACK
# A generator's first command may differ from where the arm stands by this [rad, m].
START_TOLERANCE = 1e-3
# Joint 4 bends one way only.
ELBOW_SIGN = -1.0
CARTESIAN = (GeneratorMode.CARTESIAN_POSITION, GeneratorMode.CARTESIAN_VELOCITY)
_BY_IK = "cartesian_motion_generator_joint"


class Arm:
    """Seven joints and the end effector frame.

    Attributes:
        q: joint positions [rad], shape (7,)
        dq: joint velocities [rad/s], shape (7,)
        q_d: joint positions that the motion generator commanded last [rad], shape (7,)
        dq_d: joint velocities that it commanded last [rad/s], shape (7,)
        ddq_d: joint accelerations that it commanded last [rad/s^2], shape (7,)
        tau_d: torques that the client commanded last [N m], shape (7,)
        O_T_EE: pose of the end effector, shape (16,), column-major
        O_T_EE_c: pose that the Cartesian generator commanded last, as `O_T_EE`
        O_dP_EE_c: twist that it commanded last [m/s, rad/s], shape (6,)
        O_ddP_EE_c: that twist's derivative [m/s^2, rad/s^2], shape (6,)
        elbow: angle of joint 3 that it commanded last [rad]
        delbow: that angle's velocity [rad/s]
        ddelbow: that angle's acceleration [rad/s^2]
        wrench: contact on the end effector, in the base frame [N, N m], shape (6,)
    """

    def __init__(self, model: ModelLibrary, *, q: np.ndarray) -> None:
        self._model = model
        self.F_T_EE = flange_T_tcp().T.ravel()
        self.wrench = np.zeros(6)
        self.place(q)

    def place(self, q: np.ndarray) -> None:
        """Put the arm at joint positions [rad] (7,), at rest."""
        self.q = np.array(q, dtype=np.float64)
        if self.q.shape != (7,) or not np.isfinite(self.q).all():
            raise InputError(f"q: seven finite joint positions [rad], not {q}")
        self.hold()

    def hold(self) -> None:
        """Come to rest where the arm is, and forget what was commanded."""
        self.dq = np.zeros(7)
        self.q_d, self.dq_d, self.ddq_d = self.q.copy(), np.zeros(7), np.zeros(7)
        self.tau_d = np.zeros(7)
        self.O_dP_EE_c, self.O_ddP_EE_c = np.zeros(6), np.zeros(6)
        self.elbow, self.delbow, self.ddelbow = float(self.q[2]), 0.0, 0.0
        self._steers_elbow = False
        self._refresh()
        self.O_T_EE_c = self.O_T_EE.copy()

    def _refresh(self) -> None:
        self.O_T_EE = self._model.pose(self.q, self.F_T_EE)
        self._J = self._model.jacobian(self.q, self.F_T_EE)

    @property
    def base_T_tcp(self) -> np.ndarray:
        """Pose of the end effector, shape (4, 4) [m]."""
        return self.O_T_EE.reshape(4, 4).T

    @property
    def twist(self) -> np.ndarray:
        """Velocity of the end effector in the base frame, shape (6,) [m/s, rad/s]."""
        return self._J @ self.dq

    @property
    def tau_ext(self) -> np.ndarray:
        """Joint torques of the contact, shape (7,) [N m]."""
        return self._J.T @ self.wrench

    def follow(
        self, command: np.void, *, generator: GeneratorMode, controller: ControllerMode, first: bool
    ) -> tuple[str, ...]:
        """Obey one command for 1 ms; returns the names of the limits it violates.

        Args:
            command: a ROBOT_COMMAND record
            generator: what the motion in progress follows
            controller: what turns that into torques
            first: whether this is the motion's first command
        """
        with np.errstate(over="ignore", invalid="ignore"):  # such numbers are beyond every limit
            if controller == ControllerMode.EXTERNAL:
                names = self._torque(command["tau_J_d"])
            else:
                names = self._generate(command, generator, first=first)
                if not names and command["motion_generation_finished"]:
                    names = self._end(generator)
        self._refresh()
        return names

    def go_on(self, *, generator: GeneratorMode, controller: ControllerMode) -> tuple[str, ...]:
        """Let 1 ms pass for which no command came; returns the names of the limits it violates.

        The commanded velocity goes on at its last acceleration; torques stay as they were.

        Source: Franka Control Interface documentation, "Network requirements".
        """
        command = np.zeros(1, ROBOT_COMMAND)[0]
        command["tau_J_d"] = self.tau_d
        command["dq_c"] = self.dq_d + DT * self.ddq_d
        command["q_c"] = self.q_d + DT * command["dq_c"]
        twist = self.O_dP_EE_c + DT * self.O_ddP_EE_c
        command["O_dP_EE_c"] = twist
        pose = moved_on(self.O_T_EE_c.reshape(4, 4).T, DT * twist)
        command["O_T_EE_c"] = pose.T.ravel()
        command["valid_elbow"] = self._steers_elbow
        elbow = self.elbow + DT * (self.delbow + DT * self.ddelbow)
        command["elbow_c"] = (elbow, ELBOW_SIGN)
        return self.follow(command, generator=generator, controller=controller, first=False)

    def _generate(
        self, command: np.void, generator: GeneratorMode, *, first: bool
    ) -> tuple[str, ...]:
        if generator == GeneratorMode.JOINT_POSITION:
            if first and not np.abs(command["q_c"] - self.q).max() <= START_TOLERANCE:
                return ("joint_position_motion_generator_start_pose_invalid",)
            return self._move_joints((command["q_c"] - self.q_d) / DT, command["q_c"])
        if generator == GeneratorMode.JOINT_VELOCITY:
            return self._move_joints(command["dq_c"], self.q_d + DT * command["dq_c"])
        if generator == GeneratorMode.CARTESIAN_VELOCITY:
            twist = command["O_dP_EE_c"]
            return self._move_end_effector(twist, DT * twist, command, first=first)
        pose = command["O_T_EE_c"]
        if not is_frame(pose):
            return ("cartesian_position_motion_generator_invalid_frame_flag",)
        target, current = pose.reshape(4, 4).T, self.base_T_tcp
        # One Gauss-Newton step from where the arm is.
        step = difference(current, target)
        if first and not np.abs(step).max() <= START_TOLERANCE:
            return ("cartesian_position_motion_generator_start_pose_invalid",)
        twist = difference(self.O_T_EE_c.reshape(4, 4).T, target) / DT
        names = self._move_end_effector(twist, step, command, first=first)
        self.O_T_EE_c = pose.copy()
        return names

    def _end(self, generator: GeneratorMode) -> tuple[str, ...]:
        """The names of the limits that are violated by standing still from now on."""
        if generator not in CARTESIAN:
            return excess_at_end(self.dq_d, self.ddq_d, joint_excess)
        names = excess_at_end(self.O_dP_EE_c, self.O_ddP_EE_c, twist_excess)
        if self._steers_elbow:
            elbow = np.array([self.delbow]), np.array([self.ddelbow])
            names += excess_at_end(*elbow, elbow_excess)
        return names

    def _torque(self, tau: np.ndarray) -> tuple[str, ...]:
        """Accelerate under the commanded torque and the contact; semi-implicit Euler."""
        names = torque_excess(tau, self.tau_d)
        if names:
            return names
        self.tau_d = tau.copy()
        self.dq = self.dq + DT * (tau + self.tau_ext - FRICTION * self.dq) / _INERTIA
        self.q = self.q + DT * self.dq
        self.q_d = self.q.copy()
        if (np.abs(self.dq) > _DQ_GREATEST).any():
            return ("joint_velocity_violation",)
        return ("joint_position_limits_violation",) if _outward(self.q, self.dq) else ()

    def _move_joints(
        self, dq: np.ndarray, q: np.ndarray, *, by: str = "joint_motion_generator"
    ) -> tuple[str, ...]:
        """Take the joints to `q` at `dq`, unless a limit forbids it."""
        ddq = (dq - self.dq_d) / DT
        names = joint_excess(dq, ddq, (ddq - self.ddq_d) / DT, by=by)
        if _outward(q, dq):
            names = (f"{by}_position_limits_violation", *names)
        if names:
            return names
        self.q, self.dq = q.copy(), dq.copy()
        self.q_d, self.dq_d, self.ddq_d = q.copy(), dq.copy(), ddq
        return ()

    def _move_end_effector(
        self, twist: np.ndarray, step: np.ndarray, command: np.void, *, first: bool
    ) -> tuple[str, ...]:
        """Move the end effector by `step` while `twist` is what was commanded."""
        rate = (twist - self.O_dP_EE_c) / DT
        names = twist_excess(twist, rate, (rate - self.O_ddP_EE_c) / DT)
        rows, steps = self._J, step
        if command["valid_elbow"] or self._steers_elbow:
            names += self._steer_elbow(command, first=first)
            rows, steps = np.vstack([rows, np.eye(7)[2]]), np.append(step, self.elbow - self.q[2])
        if names:
            return names
        self.O_dP_EE_c, self.O_ddP_EE_c = twist.copy(), rate
        dq = np.linalg.lstsq(rows, steps, rcond=1e-4)[0] / DT
        return self._move_joints(dq, self.q + DT * dq, by=_BY_IK)

    def _steer_elbow(self, command: np.void, *, first: bool) -> tuple[str, ...]:
        """Take over where joint 3 shall be, unless a limit forbids it."""
        elbow, sign = (float(number) for number in command["elbow_c"])
        if first:
            self._steers_elbow = bool(command["valid_elbow"])
            if sign != ELBOW_SIGN or not abs(elbow - self.q[2]) <= START_TOLERANCE:
                return ("cartesian_motion_generator_start_elbow_invalid",)
        if not command["valid_elbow"] or not self._steers_elbow or sign != ELBOW_SIGN:
            return ("cartesian_motion_generator_elbow_sign_inconsistent",)
        velocity = (elbow - self.elbow) / DT
        rate = (velocity - self.delbow) / DT
        jerk = (rate - self.ddelbow) / DT
        names = elbow_excess(np.array([velocity]), np.array([rate]), np.array([jerk]))
        if not names:
            self.elbow, self.delbow, self.ddelbow = elbow, velocity, rate
        return names


def _outward(q: np.ndarray, dq: np.ndarray) -> bool:
    """Return whether a joint is beyond its range and moves farther out."""
    below, above = q < Q_MIN, q > Q_MAX
    if not (below | above).any():  # as in all but a few milliseconds
        return False
    return bool(((below & (dq < 0)) | (above & (dq > 0))).any())
