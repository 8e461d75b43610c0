"""Robot arms over the table: kinematics on pytorch-kinematics, reach, meshes."""

from __future__ import annotations

from functools import cache

from warp_deform.errors import InputError
from warp_deform.robots.arm import Robot
from warp_deform.robots.kinematics import IKResult
from warp_deform.robots.panda import PANDA
from warp_deform.robots.ur5 import UR5

__all__ = ["IKResult", "Robot", "robot"]

_CONFIGS = {config.name: config for config in (UR5, PANDA)}


def robot(name: str) -> Robot:
    """Return the robot called `name`, "ur5" or "panda"; the same instance on every call.

    Raises:
        InputError: there is no robot of that name
    """
    if name not in _CONFIGS:
        raise InputError(f"robot: one of {', '.join(_CONFIGS)}, not {name!r}")
    return _build(name)


@cache
def _build(name: str) -> Robot:
    """Build a robot once per process."""
    return Robot(_CONFIGS[name])
