"""What stops a Panda, and what lets it go on: reflexes, the user stop, `stop`, Ctrl-C."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from fixtures.emulator_client import (
    ABOVE_TABLE,
    HOME,
    OFF_HOME,
    Background,
    says_what_to_do,
    wait_for_motion,
)

from hardware import MotionError, ReflexError, RobotMode, UserStopped
from hardware.arm.stop_latch import StopLatch
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(180)]


@pytest.fixture
def robot(ready_panda: PandaRobot) -> PandaRobot:
    return ready_panda


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
