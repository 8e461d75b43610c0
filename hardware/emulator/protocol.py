"""The bytes of the Franka Control Interface: robot server version 5, gripper server version 3.

Commands and replies travel over TCP (robot port 1337, gripper port 1338), states and motion
commands over UDP at 1 kHz. Everything is packed and little-endian; matrices are column-major.

Source: the Apache-2.0 headers `research_interface/{robot,gripper}` of libfranka-common, as used by
libfranka 0.9.2, the last release for the Panda.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np

__all__ = [
    "ERRORS",
    "GRIPPER_COMMAND_PORT",
    "GRIPPER_VERSION",
    "ROBOT_COMMAND",
    "ROBOT_COMMAND_PORT",
    "ROBOT_STATE",
    "ROBOT_VERSION",
    "ControllerMode",
    "GeneratorMode",
    "GripperCommand",
    "GripperStatus",
    "MoveStatus",
    "Request",
    "RobotCommand",
    "RobotMode",
    "SetStatus",
    "Stream",
    "pack_gripper_state",
]

ROBOT_COMMAND_PORT, ROBOT_VERSION = 1337, 5
GRIPPER_COMMAND_PORT, GRIPPER_VERSION = 1338, 3


class RobotCommand(IntEnum):
    """What a client asks of the robot, u32."""

    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    GET_CARTESIAN_LIMIT = 3
    SET_COLLISION_BEHAVIOR = 4
    SET_JOINT_IMPEDANCE = 5
    SET_CARTESIAN_IMPEDANCE = 6
    SET_GUIDING_MODE = 7
    SET_EE_TO_K = 8
    SET_NE_TO_EE = 9
    SET_LOAD = 10
    SET_FILTERS = 11
    AUTOMATIC_ERROR_RECOVERY = 12
    LOAD_MODEL_LIBRARY = 13


class GripperCommand(IntEnum):
    """What a client asks of the gripper, u16."""

    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


class MoveStatus(IntEnum):
    """How a Move ends; MOTION_STARTED is the first of its two replies."""

    SUCCESS = 0
    MOTION_STARTED = 1
    PREEMPTED = 2
    NOT_POSSIBLE = 3
    START_AT_SINGULAR_POSE = 4
    INVALID_ARGUMENT = 5
    REFLEX_ABORTED = 6
    EMERGENCY_ABORTED = 7
    INPUT_ERROR_ABORTED = 8
    ABORTED = 9


class SetStatus(IntEnum):
    """How every other command to the robot ends; some know only the first two."""

    SUCCESS = 0
    NOT_POSSIBLE = 1
    INVALID_ARGUMENT = 2


class GripperStatus(IntEnum):
    """How a gripper command ends, u16."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


class RobotMode(IntEnum):
    """What the robot as a whole is doing."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    AUTOMATIC_ERROR_RECOVERY = 6


class GeneratorMode(IntEnum):
    """Which motion generator a state reports; a Move request counts from 0 without IDLE."""

    IDLE = 0
    JOINT_POSITION = 1
    JOINT_VELOCITY = 2
    CARTESIAN_POSITION = 3
    CARTESIAN_VELOCITY = 4


class ControllerMode(IntEnum):
    """Which controller runs; EXTERNAL means torques from the client."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    OTHER = 3


# In the order of the flags in a state, named as libfranka prints them.
ERRORS = (
    "joint_position_limits_violation",
    "cartesian_position_limits_violation",
    "self_collision_avoidance_violation",
    "joint_velocity_violation",
    "cartesian_velocity_violation",
    "force_control_safety_violation",
    "joint_reflex",
    "cartesian_reflex",
    "max_goal_pose_deviation_violation",
    "max_path_pose_deviation_violation",
    "cartesian_velocity_profile_safety_violation",
    "joint_position_motion_generator_start_pose_invalid",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "cartesian_position_motion_generator_start_pose_invalid",
    "cartesian_motion_generator_elbow_limit_violation",
    "cartesian_motion_generator_velocity_limits_violation",
    "cartesian_motion_generator_velocity_discontinuity",
    "cartesian_motion_generator_acceleration_discontinuity",
    "cartesian_motion_generator_elbow_sign_inconsistent",
    "cartesian_motion_generator_start_elbow_invalid",
    "force_controller_desired_force_tolerance_violation",
    "start_elbow_sign_inconsistent",
    "communication_constraints_violation",
    "power_limit_violation",
    "cartesian_motion_generator_joint_position_limits_violation",
    "cartesian_motion_generator_joint_velocity_limits_violation",
    "cartesian_motion_generator_joint_velocity_discontinuity",
    "cartesian_motion_generator_joint_acceleration_discontinuity",
    "cartesian_position_motion_generator_invalid_frame_flag",
    "controller_torque_discontinuity",
    "joint_p2p_insufficient_torque_for_planning",
    "tau_J_range_violation",
    "instability_detected",
    "joint_move_in_wrong_direction",
)
ERROR_FLAGS = 41


def _doubles(**sizes: int) -> list[tuple[str, str, tuple[int, ...]]]:
    return [(name, "<f8", (size,)) for name, size in sizes.items()]


ROBOT_STATE = np.dtype(
    [
        ("message_id", "<u8"),
        *_doubles(O_T_EE=16, O_T_EE_d=16, F_T_EE=16, EE_T_K=16, F_T_NE=16, NE_T_EE=16),
        *_doubles(m_ee=1, I_ee=9, F_x_Cee=3, m_load=1, I_load=9, F_x_Cload=3),
        *_doubles(elbow=2, elbow_d=2, tau_J=7, tau_J_d=7, dtau_J=7, q=7, q_d=7, dq=7, dq_d=7),
        *_doubles(ddq_d=7, joint_contact=7, cartesian_contact=6, joint_collision=7),
        *_doubles(cartesian_collision=6, tau_ext_hat_filtered=7, O_F_ext_hat_K=6),
        *_doubles(K_F_ext_hat_K=6, O_dP_EE_d=6, O_ddP_O=3, elbow_c=2, delbow_c=2, ddelbow_c=2),
        *_doubles(O_T_EE_c=16, O_dP_EE_c=6, O_ddP_EE_c=6, theta=7, dtheta=7),
        ("motion_generator_mode", "u1"),
        ("controller_mode", "u1"),
        ("errors", "?", (ERROR_FLAGS,)),
        ("reflex_reason", "?", (ERROR_FLAGS,)),
        ("robot_mode", "u1"),
        ("control_command_success_rate", "<f8"),
    ]
)
ROBOT_COMMAND = np.dtype(
    [
        ("message_id", "<u8"),
        *_doubles(q_c=7, dq_c=7, O_T_EE_c=16, O_dP_EE_c=6, elbow_c=2),
        ("valid_elbow", "?"),
        ("motion_generation_finished", "?"),
        *_doubles(tau_J_d=7),
    ]
)
_GRIPPER_STATE = struct.Struct("<Idd?H")
_CELSIUS = 30


def pack_gripper_state(message_id: int, *, width: float, max_width: float, grasped: bool) -> bytes:
    """Return the datagram of a gripper state; widths in [m]."""
    return _GRIPPER_STATE.pack(message_id & 0xFFFFFFFF, width, max_width, grasped, _CELSIUS)


class Request(NamedTuple):
    """A command as it came over TCP: which, its number, and what follows the header."""

    command: int
    command_id: int
    body: bytes


class Stream:
    """Cuts a TCP byte stream into requests and frames the replies.

    Args:
        command: struct code of the command number, "I" for the robot, "H" for the gripper
        status: struct code of a reply's status, "B" for the robot, "H" for the gripper
    """

    # A request longer than this is not one: SetCollisionBehavior, the longest, has 428 bytes.
    LONGEST = 4096

    def __init__(self, *, command: str, status: str) -> None:
        self._header = struct.Struct(f"<{command}II")
        self._status = struct.Struct(f"<{status}")
        self._pending = b""

    def requests(self, received: bytes) -> Iterator[Request]:
        """Yield the requests that `received` completes.

        Raises:
            ValueError: the bytes are no request of this protocol
        """
        self._pending += received
        while len(self._pending) >= self._header.size:
            command, command_id, size = self._header.unpack_from(self._pending)
            if not self._header.size <= size <= self.LONGEST:
                raise ValueError(f"a request of {size} bytes")
            if len(self._pending) < size:
                return
            body, self._pending = self._pending[self._header.size : size], self._pending[size:]
            yield Request(command, command_id, body)

    def reply(self, command: int, command_id: int, status: int, payload: bytes = b"") -> bytes:
        """Return the bytes of a reply."""
        body = self._status.pack(status) + payload
        return self._header.pack(command, command_id, self._header.size + len(body)) + body
