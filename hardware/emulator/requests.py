"""What a request may say: the length of its body, the range of its numbers, and how it is refused.

Source: the structs and status codes of libfranka-common; the ranges of impedances and of the
filters' cut-off frequencies are those in the documentation of libfranka's `Robot`.
"""

from __future__ import annotations

import platform
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arm.panda import GRIPPER_MAX_WIDTH
from .frames import is_frame
from .protocol import GripperCommand, GripperStatus, MoveStatus, Request, RobotCommand, SetStatus

__all__ = ["GRIPPER_FORMS", "ROBOT_FORMS", "Form", "read"]

JOINT_STIFFNESS_MAX = 14250.0  # [N m/rad]
# Translation [N/m] and rotation [N m/rad].
CARTESIAN_STIFFNESS = np.array([[10.0] * 3 + [1.0] * 3, [3000.0] * 3 + [300.0] * 3])
FILTER_FREQUENCY_MAX = 1000.0  # [Hz]
LINUX = 0
MACHINES = {"x86_64": 0, "i386": 1, "i686": 1, "armv7l": 2, "aarch64": 3}
CONTROLLERS, GENERATORS = 3, 4


@dataclass(frozen=True)
class Form:
    """One command's body, and the status that tells a client that it is wrong.

    Attributes:
        layout: struct code of the body
        refusal: status of the reply to a body of another length, or whose numbers are not valid
        valid: whether the numbers are within what the robot accepts
    """

    layout: struct.Struct
    refusal: int
    valid: Callable[[np.ndarray], bool]


def read(request: Request, forms: Mapping[int, Form]) -> tuple[Any, ...] | None:
    """Return the values in a request's body; None where they have to be refused.

    Raises:
        ValueError: there is no such command
    """
    form = forms.get(request.command)
    if form is None:
        raise ValueError(f"no command has number {request.command}")
    if len(request.body) != form.layout.size:
        return None
    values = form.layout.unpack(request.body)
    return values if form.valid(np.array(values, dtype=np.float64)) else None


def _form(
    layout: str, refusal: int, valid: Callable[[np.ndarray], Any] = lambda values: True
) -> Form:
    return Form(struct.Struct(f"<{layout}"), int(refusal), lambda values: bool(valid(values)))


def _not_negative(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and (values >= 0.0).all())


def _within(low: np.ndarray | float, high: np.ndarray | float) -> Callable[[np.ndarray], bool]:
    # A comparison with NaN is false, one with an infinity is never within.
    return lambda values: bool(((low <= values) & (values <= high)).all())


_SET, _NOT_NOW = SetStatus.INVALID_ARGUMENT, SetStatus.NOT_POSSIBLE

ROBOT_FORMS: dict[int, Form] = {
    RobotCommand.MOVE: _form(
        "2I6d",
        MoveStatus.INVALID_ARGUMENT,
        lambda v: v[0] < CONTROLLERS and v[1] < GENERATORS and _not_negative(v[2:]),
    ),
    RobotCommand.STOP_MOVE: _form("", _NOT_NOW),
    RobotCommand.GET_CARTESIAN_LIMIT: _form("i", _SET),
    RobotCommand.SET_COLLISION_BEHAVIOR: _form("52d", _SET, _not_negative),
    RobotCommand.SET_JOINT_IMPEDANCE: _form("7d", _SET, _within(0.0, JOINT_STIFFNESS_MAX)),
    RobotCommand.SET_CARTESIAN_IMPEDANCE: _form("6d", _SET, _within(*CARTESIAN_STIFFNESS)),
    RobotCommand.SET_GUIDING_MODE: _form("7B", _SET, _within(0.0, 1.0)),
    RobotCommand.SET_EE_TO_K: _form("16d", _SET, is_frame),
    RobotCommand.SET_NE_TO_EE: _form("16d", _SET, is_frame),
    # Mass, its centre, its inertia.
    RobotCommand.SET_LOAD: _form("13d", _SET, lambda v: np.isfinite(v).all() and v[0] >= 0.0),
    RobotCommand.SET_FILTERS: _form(
        "5d", _SET, lambda v: (v > 0.0).all() and (v <= FILTER_FREQUENCY_MAX).all()
    ),
    RobotCommand.AUTOMATIC_ERROR_RECOVERY: _form("", _NOT_NOW),
    # Architecture and system of the client; it gets the library compiled here, or none.
    RobotCommand.LOAD_MODEL_LIBRARY: _form(
        "2B", _NOT_NOW, lambda v: v[0] == MACHINES.get(platform.machine()) and v[1] == LINUX
    ),
}


def _move_fingers(values: np.ndarray) -> bool:
    width, speed = values
    return bool(0.0 <= width <= GRIPPER_MAX_WIDTH and 0.0 < speed < np.inf)


def _grasp(values: np.ndarray) -> bool:
    # Width, inner and outer tolerance, speed, force.
    return _not_negative(values) and values[0] <= GRIPPER_MAX_WIDTH and values[3] > 0.0


GRIPPER_FORMS: dict[int, Form] = {
    GripperCommand.HOMING: _form("", GripperStatus.FAIL),
    GripperCommand.GRASP: _form("5d", GripperStatus.FAIL, _grasp),
    GripperCommand.MOVE: _form("2d", GripperStatus.FAIL, _move_fingers),
    GripperCommand.STOP: _form("", GripperStatus.FAIL),
}
