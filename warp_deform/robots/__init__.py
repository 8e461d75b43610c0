"""Robot arms over the table: kinematics on pytorch-kinematics, reach, meshes."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Literal

from warp_deform.errors import InputError
from warp_deform.robots.arm import Robot
from warp_deform.robots.kinematics import IKResult
from warp_deform.robots.panda import PANDA
from warp_deform.robots.ur5 import UR5

__all__ = ["ROBOTS", "IKResult", "Robot", "RobotName", "robot"]

ROBOTS = {config.name: config for config in (UR5, PANDA)}
"""The arms by name. A new one is a line here: options, tests and benchmarks run over this."""

if TYPE_CHECKING:
    RobotName = str
    """Name of an arm, one of `ROBOTS`."""
else:  # the choices that a command's help shows
    RobotName = Literal[tuple(ROBOTS)]


def robot(name: str) -> Robot:
    """Return the robot called `name`, one of `ROBOTS`; the same instance on every call.

    Raises:
        InputError: there is no robot of that name
    """
    if name not in ROBOTS:
        raise InputError(f"robot: one of {', '.join(ROBOTS)}, not {name!r}")
    return _build(name)


@cache
def _build(name: str) -> Robot:
    """Build a robot once per process."""
    return Robot(ROBOTS[name])
