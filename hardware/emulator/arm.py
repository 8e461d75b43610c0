"""The emulated arm: joint state, the four motion generators, torque control, and their limits.

Motion generators are followed exactly. Torques accelerate joints of constant, diagonal inertia with
a little viscous friction; contact pushes back through the Jacobian. A violated limit stops the arm
at once and is returned by the name that libfranka prints.

Source for the Cartesian and torque rate limits: Franka Control Interface documentation, "Robot and
interface specifications", Panda.
"""

from __future__ import annotations

import numpy as np

from warp_deform.errors import InputError

from ..panda_arm import DDQ_MAX, DQ_MAX, Q_MAX, Q_MIN, TAU_MAX, flange_T_tcp
from .frames import difference, is_frame
from .model_library import INERTIA, ModelLibrary
from .protocol import ControllerMode, GeneratorMode

__all__ = ["Arm"]

DT = 1e-3  # [s], the interface's period
TAU_RATE_MAX = 1000.0  # [N m/s]
# Translation [m/s], [m/s^2] and rotation [rad/s], [rad/s^2] of the end effector.
TWIST_MAX = np.array([1.7] * 3 + [2.5] * 3)
TWIST_RATE_MAX = np.array([13.0] * 3 + [25.0] * 3)
# What rounding may add to a limit before it counts as violated.
SLACK = 1.001
FRICTION = 0.5  # [N m s/rad]
# A generator's first command may differ from where the arm stands by this [rad, m].
START_TOLERANCE = 1e-3


class Arm:
    """Seven joints and the end effector frame.

    Attributes:
        q, dq: joint positions [rad] and velocities [rad/s], shape (7,)
        q_d, dq_d, ddq_d: what the motion generator commanded last, shape (7,)
        tau_d: torques that the client commanded last [N m], shape (7,)
        O_T_EE: pose of the end effector, shape (16,), column-major
        O_T_EE_c, O_dP_EE_c, O_ddP_EE_c: what the Cartesian generator commanded last
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
    ) -> str | None:
        """Obey one command for 1 ms; returns the name of the limit it violates, if any.

        Args:
            command: a ROBOT_COMMAND record
            generator, controller: the modes of the motion in progress
            first: whether this is the motion's first command
        """
        if controller == ControllerMode.EXTERNAL:
            violation = self._torque(command["tau_J_d"])
        elif generator == GeneratorMode.JOINT_POSITION:
            if first and not np.abs(command["q_c"] - self.q).max() <= START_TOLERANCE:
                return "joint_position_motion_generator_start_pose_invalid"
            violation = self._joint_velocity((command["q_c"] - self.q_d) / DT, command["q_c"])
        elif generator == GeneratorMode.JOINT_VELOCITY:
            violation = self._joint_velocity(command["dq_c"], self.q_d + DT * command["dq_c"])
        elif generator == GeneratorMode.CARTESIAN_POSITION:
            violation = self._pose(command["O_T_EE_c"], first=first)
        else:
            violation = self._twist(command["O_dP_EE_c"], command["O_dP_EE_c"] * DT)
        self._refresh()
        if generator == GeneratorMode.CARTESIAN_POSITION:
            self.O_T_EE_c = command["O_T_EE_c"].copy()
        return violation

    def _torque(self, tau: np.ndarray) -> str | None:
        """Accelerate under the commanded torque and the contact; semi-implicit Euler."""
        if not np.isfinite(tau).all() or (np.abs(tau) > TAU_MAX * SLACK).any():
            return "tau_J_range_violation"
        if (np.abs(tau - self.tau_d) > TAU_RATE_MAX * DT * SLACK).any():
            return "controller_torque_discontinuity"
        self.tau_d = tau.copy()
        self.dq = self.dq + DT * (tau + self.tau_ext - FRICTION * self.dq) / INERTIA
        self.q = self.q + DT * self.dq
        self.q_d = self.q.copy()
        if (np.abs(self.dq) > DQ_MAX * SLACK).any():
            return "joint_velocity_violation"
        outward = ((self.q < Q_MIN) & (self.dq < 0)) | ((self.q > Q_MAX) & (self.dq > 0))
        return "joint_position_limits_violation" if outward.any() else None

    def _joint_velocity(
        self, dq: np.ndarray, q: np.ndarray, prefix: str = "joint_motion_generator"
    ) -> str | None:
        """Take the joints to `q` at `dq`, unless a limit forbids it."""
        ddq = (dq - self.dq_d) / DT
        outward = ((q < Q_MIN) & (dq < 0)) | ((q > Q_MAX) & (dq > 0))
        if outward.any():
            return f"{prefix}_position_limits_violation"
        if not (np.abs(dq) <= DQ_MAX * SLACK).all():
            return f"{prefix}_velocity_limits_violation"
        # Rounding of positions, divided by DT twice.
        if not (np.abs(ddq) <= DDQ_MAX * SLACK + 1e-6).all():
            return f"{prefix}_velocity_discontinuity"
        self.q, self.dq = q.copy(), dq.copy()
        self.q_d, self.dq_d, self.ddq_d = q.copy(), dq.copy(), ddq
        return None

    def _pose(self, O_T_EE_c: np.ndarray, *, first: bool) -> str | None:
        """Follow a commanded pose by one Gauss-Newton step from where the arm is."""
        target, current = O_T_EE_c.reshape(4, 4).T, self.base_T_tcp
        if not is_frame(O_T_EE_c):
            return "cartesian_position_motion_generator_invalid_frame_flag"
        if first and not np.linalg.norm(target[:3, 3] - current[:3, 3]) < START_TOLERANCE:
            return "cartesian_position_motion_generator_start_pose_invalid"
        before = self.O_T_EE_c.reshape(4, 4).T
        twist = difference(before, target) / DT
        return self._twist(twist, difference(current, target))

    def _twist(self, twist: np.ndarray, step: np.ndarray) -> str | None:
        """Move the end effector by `step` while `twist` is what was commanded."""
        rate = (twist - self.O_dP_EE_c) / DT
        if not (np.abs(twist) <= TWIST_MAX * SLACK).all():
            return "cartesian_motion_generator_velocity_limits_violation"
        if not (np.abs(rate) <= TWIST_RATE_MAX * SLACK + 1e-6).all():
            return "cartesian_motion_generator_velocity_discontinuity"
        self.O_dP_EE_c, self.O_ddP_EE_c = twist.copy(), rate
        dq = np.linalg.lstsq(self._J, step, rcond=1e-4)[0] / DT
        # Joint acceleration is not held to its limit here: redundancy is resolved afresh each step.
        self.dq_d = dq
        return self._joint_velocity(dq, self.q + DT * dq, "cartesian_motion_generator_joint")
