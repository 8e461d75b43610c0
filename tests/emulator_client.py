"""The vendor's client on an emulated Panda, and smooth commands for its callbacks."""

from __future__ import annotations

import logging
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from hardware import RobotError
from hardware.arm.panda import HOME_Q, PandaKinematics
from hardware.emulator import EmulatorProcess

# Where the vendor offers wheels they are part of the development install, so a missing one fails.
if (sys.platform, platform.machine()) == ("linux", "x86_64"):
    import panda_py
else:
    panda_py = pytest.importorskip("panda_py")
libfranka = panda_py.libfranka
HOME = np.array(HOME_Q)
ABOVE_TABLE = PandaKinematics().pose(HOME)
OFF_HOME = np.array([0.3, -0.5, 0.1, -2.2, 0.05, 1.7, 0.9])
logging.getLogger("panda").addHandler(logging.NullHandler())
logging.getLogger("motion").addHandler(logging.NullHandler())


@contextmanager
def vendor_client(host: str) -> Iterator[SimpleNamespace]:
    """panda, robot and gripper of the vendor; let go of before the emulator ends."""
    client = SimpleNamespace(panda=panda_py.Panda(host), gripper=libfranka.Gripper(host))
    client.robot = client.panda.get_robot()
    try:
        yield client
    finally:
        vars(client).clear()


def reset(client: SimpleNamespace, emulator: EmulatorProcess) -> None:
    """Put the arm at home, with nothing between the fingers, and default thresholds."""
    emulator.user_stop(False)
    client.panda.recover()
    emulator.place(HOME)
    emulator.call_world("place_object", width=0.0)
    emulator.call_world("take")
    client.panda.set_default_behavior()


def min_jerk(t: float) -> float:
    """A smooth rise from 0 at t = 0 to 1 at t = 1, at rest at both ends."""
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def timed(make: Callable[[float, object], object], *, seconds: float) -> Callable[..., object]:
    """A libfranka callback: `make(time, state)` until `seconds` have passed."""
    clock = 0.0

    def callback(state: object, duration: object) -> object:
        nonlocal clock
        clock += duration.to_sec()
        command = make(clock, state)
        return libfranka.motion_finished(command) if clock >= seconds else command

    return callback


def says_what_to_do(error: RobotError) -> bool:
    """One line, which ends with the advice."""
    text = str(error)
    return "\n" not in text and bool(error.advice) and text.endswith(f"; {error.advice}")


def moved(x: float, y: float, z: float, *, yaw: float = 0.0) -> np.ndarray:
    """The home pose, moved [m] and turned about the vertical [rad]."""
    T = ABOVE_TABLE.copy()
    c, s = np.cos(yaw), np.sin(yaw)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T[:3, :3]
    T[:3, 3] += [x, y, z]
    return T
