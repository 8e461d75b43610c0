"""The Panda backend with the vendor's real client, against the emulator: no error goes untyped."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from fixtures.emulator_client import (
    ABOVE_TABLE,
    HOME,
    OFF_HOME,
    Background,
    moved,
    says_what_to_do,
    wait_for_motion,
)
from fixtures.emulator_worlds import TABLE_Z, RecordingWorld
from fixtures.safety_spy import joints_at

from hardware import (
    GraspError,
    ReflexError,
    RobotMode,
    UnreachablePose,
)
from hardware.arm.panda import PandaKinematics
from hardware.arm.straight_line import distance
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from warp_deform.errors import InputError

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(180)]
LOW = joints_at(moved(0.08, 0.03, -0.33))  # some centimetres over the table


@pytest.fixture
def robot(ready_panda: PandaRobot) -> PandaRobot:
    return ready_panda


# What works.


def test_connecting_moves_nothing(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    before = emulator.snapshot()
    state = robot.state()
    assert emulator.snapshot()["ticks"] == before["ticks"]
    np.testing.assert_array_equal(state.q, HOME)
    np.testing.assert_allclose(state.base_T_tcp, ABOVE_TABLE, atol=1e-12)
    np.testing.assert_array_equal(state.base_T_tcp, robot.pose(state.q))
    assert (state.mode, state.gripper_width_m) == (RobotMode.IDLE, 0.08)
    assert state.force_N.shape == (6,)


def test_state_is_fresh(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    robot.state()
    emulator.place(OFF_HOME)
    np.testing.assert_array_equal(robot.state().q, OFF_HOME)


def test_waypoints_and_home_end_within_half_a_millimetre(
    emulator: EmulatorProcess, robot: PandaRobot
) -> None:
    points = np.array([OFF_HOME, OFF_HOME + 0.2, [0.5, -0.4, 0.1, -2.3, 0.2, 2.0, 0.6]])
    for goal in (points, points[1], HOME):
        robot.move_joints(goal, speed=0.2)
        wanted = [PandaKinematics().pose(q) for q in np.atleast_2d(goal)]
        off, turned = distance(emulator.snapshot()["base_T_tcp"], wanted[-1])
        assert off < 5e-4 and turned < 2e-3
        passed = emulator.call_world("take")["position"]
        for pose in wanted:  # gentle corners are rounded
            assert np.linalg.norm(passed - pose[:3, 3], axis=1).min() < 1e-2


def test_who_moves_the_arm_stays_an_ordinary_process(robot: PandaRobot) -> None:
    """A thread that libfranka moves a robot in keeps the highest real-time priority.

    A policy and its cameras would keep a core from everything else.
    """
    robot.move_joints(OFF_HOME, speed=0.5)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    seen = subprocess.run(
        [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert int(seen.stdout) == os.SCHED_OTHER


def test_waypoints_at_sharp_corners_are_met(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    corner = HOME + 0.2 * np.eye(7)[0]
    robot.move_joints(np.array([corner, corner + 0.2 * np.eye(7)[1], HOME]), speed=0.3)
    passed = emulator.call_world("take")["position"]
    for q in (corner, corner + 0.2 * np.eye(7)[1], HOME):
        assert np.linalg.norm(passed - PandaKinematics().pose(q)[:3, 3], axis=1).min() < 5e-4


def test_a_move_to_where_the_arm_is_takes_no_time(
    emulator: EmulatorProcess, robot: PandaRobot
) -> None:
    """The vendor's planner would search for 30 s."""
    ticks, clock = emulator.snapshot()["ticks"], time.monotonic()
    robot.move_joints(HOME, speed=0.2)
    robot.move_joints(np.array([HOME, HOME, HOME]), speed=0.2)
    assert emulator.snapshot()["ticks"] == ticks
    robot.move_joints(np.array([HOME, OFF_HOME, OFF_HOME, HOME, HOME]), speed=0.5)
    assert time.monotonic() - clock < 10.0
    assert emulator.snapshot()["ticks"] > ticks


@pytest.mark.parametrize("yaw", [0.0, 0.8, -1.2])
def test_straight_lines_are_straight_and_no_faster_than_asked(
    emulator: EmulatorProcess, robot: PandaRobot, yaw: float
) -> None:
    start = robot.state().base_T_tcp[:3, 3]
    target = moved(0.15, -0.1, -0.2, yaw=yaw)
    result = robot.move_linear(target, speed=0.1)
    record = emulator.call_world("take")
    assert not result.contact
    off, turned = distance(emulator.snapshot()["base_T_tcp"], target)
    assert off < 5e-4 and turned < 2e-3
    along = (target[:3, 3] - start) / np.linalg.norm(target[:3, 3] - start)
    away = record["position"] - start
    assert np.linalg.norm(away - np.outer(away @ along, along), axis=1).max() < 1e-3
    assert record["speed"].max() <= 0.1


def test_a_descent_stops_at_the_table(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    robot.move_linear(moved(0.2, 0, TABLE_Z + 0.03 - ABOVE_TABLE[2, 3]), speed=0.2)
    below = moved(0.2, 0, TABLE_Z - 0.03 - ABOVE_TABLE[2, 3])
    result = robot.move_linear(below, speed=0.05, stop_force_N=8.0)
    assert result.contact
    assert TABLE_Z - 5e-3 < result.base_T_tcp[2, 3] < TABLE_Z
    assert 8.0 < emulator.call_world("take")["force"].max() < 9.0
    assert robot.state().mode == RobotMode.IDLE
    free = robot.move_linear(
        moved(0.2, 0, TABLE_Z + 0.03 - ABOVE_TABLE[2, 3]), speed=0.1, stop_force_N=9.0
    )
    assert not free.contact
    # The ordinary threshold is back: the same descent goes on until that.
    with pytest.raises(ReflexError) as caught:
        robot.move_linear(below, speed=0.05)
    assert caught.value.reflexes == ("cartesian_reflex",)
    assert says_what_to_do(caught.value) and "touched something" in str(caught.value)
    assert emulator.call_world("take")["force"].max() > 20.0


def test_state_can_be_read_while_the_arm_moves(
    emulator: EmulatorProcess, robot: PandaRobot
) -> None:
    # longer than the time in which a motion that begins gives the last reading, on a fast host too
    motion = Background(lambda: robot.move_joints(OFF_HOME, speed=0.01))
    wait_for_motion(emulator)
    readings = []
    while motion.running():
        readings.append(robot.state())
        time.sleep(0.005)
    assert motion.join() is None
    turned = np.array([reading.q[0] for reading in readings])
    assert len(readings) > 5 and (np.diff(turned) >= -1e-4).all() and np.ptp(turned) > 0.1
    assert RobotMode.MOVING in {reading.mode for reading in readings}
    np.testing.assert_allclose(robot.state().q, OFF_HOME, atol=1e-3)


def test_gripper_opens_hits_and_misses(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    robot.open_gripper(0.03)
    assert robot.state().gripper_width_m == 0.03
    robot.home_gripper()
    assert robot.state().gripper_width_m == 0.08
    assert not robot.grasp(width_m=0.006, force_N=15.0)
    assert robot.state().gripper_width_m == 0.0
    robot.open_gripper()
    emulator.call_world("place_object", width=0.006)
    assert robot.grasp(width_m=0.006, force_N=15.0)
    assert robot.state().gripper_width_m == 0.006
    robot.open_gripper()
    emulator.call_world("place_object", width=0.03)
    assert not robot.grasp(width_m=0.006, force_N=15.0)  # something, but not what was expected
    with pytest.raises(GraspError) as caught:
        robot.open_gripper(0.01)  # the object is in the way
    assert says_what_to_do(caught.value)


# What goes wrong.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q": np.full(7, np.nan), "speed": 0.2}, "finite"),
        ({"q": np.zeros(6), "speed": 0.2}, "shape"),
        ({"q": HOME + 3.0, "speed": 0.2}, "joint 1 .* beyond its limits"),
        ({"q": HOME, "speed": 0.0}, "speed"),
        ({"q": HOME, "speed": 1.5}, "speed"),
        ({"base_T_tcp": np.eye(3), "speed": 0.1}, "shape"),
        ({"base_T_tcp": 2.0 * np.eye(4), "speed": 0.1}, "rigid"),
        ({"base_T_tcp": ABOVE_TABLE, "speed": -1.0}, "speed"),
        ({"base_T_tcp": ABOVE_TABLE, "speed": 0.1, "stop_force_N": 50.0}, "stop_force_N"),
    ],
)
def test_a_wrong_command_is_refused_before_anything_moves(
    emulator: EmulatorProcess, robot: PandaRobot, arguments: dict, message: str
) -> None:
    ticks = emulator.snapshot()["ticks"]
    command = robot.move_joints if "q" in arguments else robot.move_linear
    with pytest.raises(InputError, match=message):
        command(**arguments)
    assert emulator.snapshot()["ticks"] == ticks


def test_an_unreachable_pose_is_refused(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    for pose in (moved(1.0, 0, 0), moved(-0.3, 0, 0), moved(0, 0, 0.5)):
        with pytest.raises(UnreachablePose) as caught:
            robot.move_linear(pose, speed=0.1)
        assert says_what_to_do(caught.value)
    np.testing.assert_array_equal(emulator.snapshot()["q"], HOME)


def test_lock_step_gives_the_same_bits_twice() -> None:
    def run() -> list[bytes]:
        with (
            EmulatorProcess(world=RecordingWorld, free_host=True) as emulator,
            PandaRobot(NetworkedConfig(host=emulator.host)) as robot,
        ):
            emulator.place(LOW)
            robot.move_linear(moved(0.1, 0.05, -0.37, yaw=0.3), speed=0.25)
            robot.move_linear(moved(0.1, 0.05, -0.45, yaw=0.3), speed=0.05, stop_force_N=8.0)
            emulator.call_world("place_object", width=0.006)
            robot.grasp(width_m=0.006, force_N=15.0)
            robot.move_joints(LOW, speed=0.3)
            robot.open_gripper()
            state, record = robot.state(), emulator.call_world("take")
            assert record["force"].max() > 8.0
            return [state.q.tobytes(), *(record[key].tobytes() for key in sorted(record))]

    assert run() == run()
