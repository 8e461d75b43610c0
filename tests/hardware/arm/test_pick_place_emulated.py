"""The primitive and the touch-off through the vendor's client, on an emulated arm over a table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.emulator_client import HOME
from fixtures.emulator_worlds import TABLE_Z
from fixtures.safety_spy import joints_at, pose

from hardware import RobotMode, SafetyViolation
from hardware.arm.limits import SafetyLimits
from hardware.arm.pick_place import PickPlaceAction, PickPlaceOutcome, execute
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane, fit_table_plane
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from hardware.measuring.touch_off import TouchOffConfig, touch_off

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(240)]
# The emulated table meets the TCP itself, the limits' table the fingertips 9 mm below it.
SURFACE = TABLE_Z - 0.009
ACTION = PickPlaceAction((0.42, -0.12), 0.4, (0.55, 0.10), 0.9)
# Down from the vendor's home pose takes most of a motion; from here, 0.1 m above the table, little.
LOW = joints_at(pose(0.45, 0.0, SURFACE + 0.1))


def limits(height: float = SURFACE) -> SafetyLimits:
    return SafetyLimits(table=TablePlane(height))


def quick(height: float = SURFACE) -> SafetyLimits:
    """As fast as is allowed."""
    return replace(limits(height), max_joint_speed=0.2, max_speed=0.25)


@pytest.fixture
def low_panda(emulator: EmulatorProcess, ready_panda: PandaRobot) -> PandaRobot:
    """Our backend of an arm that stands low over the table."""
    emulator.place(LOW)
    return ready_panda


def test_a_cable_is_placed(emulator: EmulatorProcess, ready_panda: PandaRobot) -> None:
    emulator.call_world("place_object", width=0.004)
    result = execute(SafeRobot(ready_panda, limits()), ACTION)
    assert result.outcome == PickPlaceOutcome.PLACED
    assert result.width_after_lift_m == pytest.approx(0.004, abs=1e-4)
    assert result.base_T_place is not None
    assert np.linalg.norm(result.base_T_pick[:2, 3] - ACTION.pick_xy) < 5e-4
    assert np.linalg.norm(result.base_T_place[:2, 3] - ACTION.place_xy) < 5e-4
    np.testing.assert_allclose(ready_panda.state().q, HOME, atol=1e-3)
    # What the hand really did, every millisecond.
    record = emulator.call_world("take")
    x, y, z = record["position"].T
    assert z.min() > SURFACE + 0.009 - 1e-4
    assert x.min() > 0.335 - 0.03 and x.max() < 0.665 and np.abs(y).max() < 0.33
    moving = record["speed"] > 1e-6
    # Joint motions at 5 % of the joints' speed come to 0.1 m/s at most, lines are limited to it.
    assert record["speed"][moving].max() < 0.12


def test_a_missed_grasp_goes_home(low_panda: PandaRobot) -> None:
    result = execute(SafeRobot(low_panda, quick(), home_q=LOW), ACTION)
    assert result.outcome == PickPlaceOutcome.MISSED_GRASP
    np.testing.assert_allclose(low_panda.state().q, LOW, atol=1e-3)


def test_a_table_that_is_higher_than_thought_is_felt(
    emulator: EmulatorProcess, low_panda: PandaRobot
) -> None:
    """By 6 mm: the descent stops on contact and the cable is placed all the same."""
    emulator.call_world("place_object", width=0.004)
    result = execute(SafeRobot(low_panda, quick(SURFACE - 0.006), home_q=LOW), ACTION)
    assert result.outcome == PickPlaceOutcome.PLACED
    assert emulator.call_world("take")["force"].max() < 30.0
    assert low_panda.state().mode == RobotMode.IDLE


def test_an_action_outside_moves_nothing(
    emulator: EmulatorProcess, ready_panda: PandaRobot
) -> None:
    with pytest.raises(SafetyViolation, match="workspace y"):
        outside = PickPlaceAction((0.5, 0.4), 0.0, (0.5, 0.0), 0.0)
        execute(SafeRobot(ready_panda, limits()), outside)
    assert len(emulator.call_world("take")["speed"]) == 0


def test_touch_off_measures_the_table(low_panda: PandaRobot) -> None:
    corners = [(0.48, -0.05), (0.48, 0.05), (0.55, 0.05), (0.55, -0.05)]
    robot = SafeRobot(low_panda, quick(SURFACE - 0.02))
    points = touch_off(robot, corners, TouchOffConfig(hover_m=0.036))
    plane, residuals = fit_table_plane(points)
    errors = plane.z(np.array(corners)) - SURFACE
    assert np.abs(errors).max() < 1e-3 and np.abs(residuals).max() < 5e-4
