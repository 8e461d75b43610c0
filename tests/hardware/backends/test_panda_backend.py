"""The Panda backend with the vendor's real client, against the emulator: no error goes untyped."""

from __future__ import annotations

import shutil
import signal
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from fixtures.emulator_client import ABOVE_TABLE, HOME, OFF_HOME, moved, says_what_to_do
from fixtures.emulator_worlds import TABLE_Z, RecordingWorld

from hardware import (
    GraspError,
    MotionError,
    ReflexError,
    RobotMode,
    UnreachablePose,
    UserStopped,
)
from hardware.arm.panda import PandaKinematics
from hardware.arm.stop_latch import StopLatch
from hardware.arm.straight_line import distance
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from warp_deform.errors import InputError

pytestmark = [
    pytest.mark.emulator,
    pytest.mark.skipif(shutil.which("cc") is None, reason="the emulator needs a C compiler"),
    pytest.mark.timeout(180),
]


@pytest.fixture
def robot(emulator: EmulatorProcess, connection: PandaRobot) -> PandaRobot:
    """A connected robot at home, with nothing between its open fingers."""
    emulator.user_stop(False)
    connection.recover()
    emulator.place(HOME)
    emulator.call_world("place_object", width=0.0)
    connection.open_gripper()
    emulator.call_world("take")
    return connection


class Background:
    """A call in another thread, and the error it ended with."""

    def __init__(self, call: object) -> None:
        self.error: BaseException | None = None
        self._call = call
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._call()
        except BaseException as error:  # handed to the test
            self.error = error

    def running(self) -> bool:
        return self._thread.is_alive()

    def join(self) -> BaseException | None:
        self._thread.join(20.0)
        assert not self._thread.is_alive(), "the call hangs"
        return self.error


def wait_for_motion(emulator: EmulatorProcess) -> None:
    until = time.monotonic() + 10.0
    start = emulator.snapshot()["q"]
    while np.abs(emulator.snapshot()["q"] - start).max() < 1e-3:
        assert time.monotonic() < until, "the arm does not move"
        time.sleep(0.002)


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
    free = robot.move_linear(moved(0.2, 0, -0.2), speed=0.1, stop_force_N=9.0)
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
    motion = Background(lambda: robot.move_joints(OFF_HOME, speed=0.02))
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


def test_a_reflex_is_raised_and_recovered_from(
    emulator: EmulatorProcess, robot: PandaRobot
) -> None:
    emulator.inject_reflex("joint_velocity_violation", after_ticks=200)
    with pytest.raises(ReflexError) as caught:
        robot.move_joints(OFF_HOME, speed=0.2)
    assert caught.value.reflexes == ("joint_velocity_violation",)
    assert says_what_to_do(caught.value) and "more slowly" in str(caught.value)
    cause = caught.value.__cause__  # frames of the vendor's call would keep its objects alive
    assert cause is not None and cause.__traceback__ is None
    stands = emulator.snapshot()["q"]
    assert 0.0 < np.abs(stands - HOME).max() < np.abs(OFF_HOME - HOME).max()
    assert robot.state().mode == RobotMode.REFLEX
    with pytest.raises(ReflexError, match="stands in a reflex"):  # no silent recovery
        robot.move_joints(OFF_HOME, speed=0.2)
    np.testing.assert_array_equal(emulator.snapshot()["q"], stands)
    robot.recover()
    robot.move_joints(HOME, speed=0.2)
    assert np.abs(emulator.snapshot()["q"] - HOME).max() < 1e-3


def test_user_stop(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    motion = Background(lambda: robot.move_joints(OFF_HOME, speed=0.005))
    wait_for_motion(emulator)
    emulator.user_stop()
    error = motion.join()
    assert isinstance(error, UserStopped) and says_what_to_do(error)
    assert robot.state().mode == RobotMode.USER_STOPPED
    for command in (robot.recover, lambda: robot.move_joints(HOME, speed=0.2)):
        with pytest.raises(UserStopped):
            command()
    emulator.user_stop(False)
    assert robot.state().mode == RobotMode.IDLE  # the state shows nothing any more
    with pytest.raises(UserStopped, match="not possible") as caught:
        robot.move_joints(HOME, speed=0.5)
    assert says_what_to_do(caught.value) and "start the command again" in caught.value.advice
    robot.recover()
    robot.move_joints(HOME, speed=0.5)


class SaidLink:
    """A connection to a robot of a given mode and errors, which recovers."""

    def __init__(self, mode: str, errors: str = "[]") -> None:
        self.mode, self.errors, self.limits = mode, errors, []
        self.latch = StopLatch()

    def read(self) -> SimpleNamespace:
        errors = None if self.errors == "[]" else self.errors
        mode = SimpleNamespace(name=self.mode)
        return SimpleNamespace(robot_mode=mode, current_errors=errors, last_motion_errors="[]")

    def command(self, call: Callable[[MagicMock], None], *, timeout_s: float = 5.0) -> None:
        robot = MagicMock()
        call(robot)
        if robot.automatic_error_recovery.called:
            self.limits.append(timeout_s)
            self.mode, self.errors = "kIdle", "[]"


def said(mode: str, errors: str = "[]") -> tuple[PandaRobot, SaidLink]:
    robot, link = PandaRobot.__new__(PandaRobot), SaidLink(mode, errors)
    robot.config, robot._link, robot._thresholds_set = NetworkedConfig(), link, True
    return robot, link


@pytest.mark.parametrize("mode", ["kIdle", "kOther", "kReflex", "kAutomaticErrorRecovery"])
def test_a_recovery_is_asked_for_whatever_the_state_says_and_given_time(mode: str) -> None:
    robot, link = said(mode)
    robot.recover()
    assert link.limits == [30.0]  # users measured 16 s


@pytest.mark.parametrize(
    ("mode", "kind"),
    [("kUserStopped", UserStopped), ("kMove", ReflexError), ("kGuiding", ReflexError)],
)
def test_a_robot_in_somebodys_hands_is_not_recovered(mode: str, kind: type) -> None:
    robot, link = said(mode)
    with pytest.raises(kind) as caught:
        robot.recover()
    assert link.limits == [] and says_what_to_do(caught.value)


def test_an_idle_robot_that_reports_errors_accepts_no_motion_until_it_has_recovered() -> None:
    robot, link = said("kIdle", '["self_collision_avoidance_violation"]')
    with pytest.raises(ReflexError, match="reports self_collision_avoidance_violation"):
        robot.move_linear(ABOVE_TABLE, speed=0.1)
    robot.recover()
    assert link.limits == [30.0]


def test_stop_from_another_thread(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    motion = Background(lambda: robot.move_joints(OFF_HOME, speed=0.005))
    wait_for_motion(emulator)
    robot.stop()
    error = motion.join()
    assert isinstance(error, MotionError) and "preempted" in str(error)
    assert np.abs(emulator.snapshot()["q"] - OFF_HOME).max() > 0.1
    robot.stop()  # harmless at rest


class Planning:
    """The vendor's object, which plans for a while before it moves."""

    def __init__(self, panda: object) -> None:
        self._panda, self.begun = panda, threading.Event()

    def __getattr__(self, name: str) -> object:
        return getattr(self._panda, name)

    def move_to_joint_position(self, *arguments: object, **settings: object) -> bool:
        self.begun.set()
        time.sleep(0.3)
        return self._panda.move_to_joint_position(*arguments, **settings)


@pytest.mark.parametrize("by", ["stop", "Ctrl-C"])
def test_a_stop_while_the_vendor_plans_keeps_the_arm_from_setting_out(
    emulator: EmulatorProcess, robot: PandaRobot, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    slow = Planning(robot._link._panda)
    monkeypatch.setattr(robot._link, "_panda", slow)

    def interrupt() -> None:
        assert slow.begun.wait(10.0)
        if by == "stop":
            robot.stop()
        else:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    watcher = Background(interrupt)
    way = np.array([HOME + 0.2 * np.eye(7)[0], HOME])  # two pieces: there and back
    with pytest.raises(MotionError if by == "stop" else KeyboardInterrupt):
        robot.move_joints(way, speed=0.02)
    assert watcher.join() is None
    stands = emulator.snapshot()["q"]
    assert np.abs(stands - HOME).max() < 0.05 and emulator.snapshot()["mode"] == "idle"
    time.sleep(0.3)
    np.testing.assert_array_equal(emulator.snapshot()["q"], stands)


@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="signals")
def test_ctrl_c_stops_the_arm(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    def interrupt() -> None:
        wait_for_motion(emulator)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    watcher = Background(interrupt)
    with pytest.raises(KeyboardInterrupt):
        robot.move_joints(OFF_HOME, speed=0.005)
    assert watcher.join() is None
    assert np.abs(emulator.snapshot()["q"] - OFF_HOME).max() > 0.1
    assert emulator.snapshot()["mode"] == "idle"
    with pytest.raises(MotionError, match="holds until recover"):
        robot.open_gripper()


def test_lock_step_gives_the_same_bits_twice() -> None:
    def run() -> list[bytes]:
        with (
            EmulatorProcess(world=RecordingWorld, free_host=True) as emulator,
            PandaRobot(NetworkedConfig(host=emulator.host)) as robot,
        ):
            robot.move_linear(moved(0.2, 0.1, -0.3, yaw=0.5), speed=0.2)
            robot.move_linear(moved(0.2, 0.1, -0.45, yaw=0.5), speed=0.05, stop_force_N=8.0)
            emulator.call_world("place_object", width=0.006)
            robot.grasp(width_m=0.006, force_N=15.0)
            robot.move_joints(HOME, speed=0.3)
            robot.open_gripper()
            state, record = robot.state(), emulator.call_world("take")
            return [state.q.tobytes(), *(record[key].tobytes() for key in sorted(record))]

    assert run() == run()
