"""The hand's speed as the vendor's client drives the emulated arm, ticks and overshoot included."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.emulator_client import HOME
from fixtures.emulator_worlds import TABLE_Z

from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(180)]
LIMITS = SafetyLimits(table=TablePlane(TABLE_Z), max_joint_speed=0.2)
REACHED = HOME + np.array([0.35, 0.35, 0.1, 0.1, 0.1, 0.3, 0.2])


def test_joint_motions_of_the_vendors_client_keep_the_hands_speed(
    emulator: EmulatorProcess, connection: PandaRobot
) -> None:
    """Way-points whose corner is rounded, downwards; and home."""
    emulator.user_stop(False)
    connection.recover()
    emulator.place(HOME)
    robot = SafeRobot(connection, LIMITS)
    middle = HOME + 0.5 * (REACHED - HOME) + np.array([0.0, 0.03, 0, 0, 0, 0, 0.03])
    for move in (
        lambda: robot.move_joints(np.array([middle, REACHED]), speed=0.2),
        robot.home,
    ):
        emulator.call_world("take")
        told = move()
        record = emulator.call_world("take")
        down = -np.diff(record["position"][:, 2]) / record["dt"][1:]
        assert told.slowed and told.speed < 0.2
        assert record["speed"].max() <= LIMITS.max_speed
        assert down.max() <= LIMITS.max_descent_speed
        # and no slower than the planned reserve explains
        used = max(record["speed"].max() / LIMITS.max_speed, down.max() / LIMITS.max_descent_speed)
        assert used > 0.75
