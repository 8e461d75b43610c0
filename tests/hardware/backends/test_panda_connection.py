"""Connecting to a Panda and losing it: each failure is typed, in time, and says what to do."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.emulator_client import HOME, OFF_HOME, says_what_to_do
from fixtures.places import ROOT

from hardware import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    IncompatibleVersion,
    ReflexError,
    RobotMode,
)
from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from hardware.emulator.server import EmulatorConfig

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(180)]


@pytest.fixture
def standing(emulator: EmulatorProcess) -> EmulatorProcess:
    """An emulated Panda at home that nobody is connected to."""
    emulator.user_stop(False)
    emulator.place(HOME)
    return emulator


def test_a_robot_in_reflex_can_be_connected_to(standing: EmulatorProcess) -> None:
    with PandaRobot(NetworkedConfig(host=standing.host)) as robot:
        standing.inject_reflex("joint_reflex", after_ticks=50)
        with pytest.raises(ReflexError):
            robot.move_joints(OFF_HOME, speed=0.2)
    with PandaRobot(NetworkedConfig(host=standing.host)) as robot:
        assert robot.state().mode == RobotMode.REFLEX
        robot.recover()
        robot.move_joints(HOME, speed=0.3)
    with pytest.raises(ConnectionLost, match="closed"):
        robot.state()
    robot.close()


def test_taking_hold_of_a_robot_recovers_it_from_a_user_stop_that_no_state_shows(
    standing: EmulatorProcess,
) -> None:
    standing.user_stop()
    standing.user_stop(False)
    with PandaRobot(NetworkedConfig(host=standing.host)) as robot:
        SafeRobot(robot, SafetyLimits(table=TablePlane(0.0)))
        robot.move_joints(OFF_HOME, speed=0.5)


def test_nothing_listens() -> None:
    with pytest.raises(ConnectionFailed, match="refused") as caught:
        PandaRobot(NetworkedConfig(host="127.0.79.1"))
    assert says_what_to_do(caught.value) and "activate FCI" in caught.value.advice


def test_something_listens_that_never_answers() -> None:
    clock = time.monotonic()
    with socket.create_server(("127.0.79.2", 1337)):
        with pytest.raises(ConnectionFailed, match=r"no answer in 0\.5 s") as caught:
            PandaRobot(NetworkedConfig(host="127.0.79.2", connect_timeout_s=0.5))
    assert says_what_to_do(caught.value)
    assert time.monotonic() - clock < BOUND


def test_another_version() -> None:
    with EmulatorProcess(EmulatorConfig(version=4), free_host=True) as emulator:
        with pytest.raises(IncompatibleVersion, match="version 4") as caught:
            PandaRobot(NetworkedConfig(host=emulator.host))
        assert says_what_to_do(caught.value)


def test_the_vendors_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "panda_py", None)
    with pytest.raises(
        BackendMissing, match=r"pip install -c constraints.txt -e '\.\[panda\]'"
    ) as caught:
        PandaRobot(NetworkedConfig(host="127.0.79.1"))
    assert says_what_to_do(caught.value)


@contextmanager
def silent(emulator: EmulatorProcess) -> Iterator[None]:
    """The robot says nothing inside; another process wakes it should ours be frozen for 20 s."""
    pid = emulator._process.pid
    waker = subprocess.Popen([sys.executable, "-c", WAKER, str(pid)])
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)
        waker.kill()
        waker.wait()


WAKER = "import os, signal, sys, time; time.sleep(20); os.kill(int(sys.argv[1]), signal.SIGCONT)"
BOUND = 16.0
"""What a silent robot may cost [s]: it is heard for 1 s, a motion for 5 s; the machine is busy."""


def test_a_silent_robot_freezes_nothing(standing: EmulatorProcess) -> None:
    """The vendor waits for a command's answer with Python's lock held, up to a minute."""
    with PandaRobot(NetworkedConfig(host=standing.host)) as robot:
        robot.move_joints(HOME, speed=0.2)
        for call in (
            robot.stop,
            robot.recover,
            lambda: robot.grasp(width_m=0.01, force_N=10.0),
        ):
            with silent(standing):
                clock = time.monotonic()
                with pytest.raises(ConnectionLost) as caught:
                    call()
                assert time.monotonic() - clock < BOUND and says_what_to_do(caught.value)
        robot.recover()  # it is back


def test_a_robot_that_falls_silent_in_mid_motion_freezes_nothing() -> None:
    with (
        EmulatorProcess(free_host=True) as emulator,
        PandaRobot(NetworkedConfig(host=emulator.host)) as robot,
    ):
        ended: list[Exception] = []

        def move() -> None:
            try:
                robot.move_joints(OFF_HOME, speed=0.02)
            except ConnectionLost as error:
                ended.append(error)

        motion = threading.Thread(target=move, daemon=True)
        motion.start()
        until = time.monotonic() + 20.0
        while emulator.snapshot()["ticks"] < 500 and time.monotonic() < until:
            time.sleep(0.005)
        with silent(emulator):
            time.sleep(0.2)  # what was under way has arrived; the vendor notices after 1 s
            clock = time.monotonic()
            with pytest.raises(ConnectionLost):
                robot.stop()
            assert time.monotonic() - clock < BOUND
            motion.join(BOUND)
            assert len(ended) == 1 and says_what_to_do(ended[0])
            for call in (robot.state, robot.recover, lambda: robot.move_joints(HOME, speed=0.2)):
                with pytest.raises(ConnectionLost):
                    call()
            robot.close()
            assert time.monotonic() - clock < BOUND


KILLED = """
import json, threading, time
import numpy as np
from hardware import ConnectionLost
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess

if __name__ == "__main__":
    emulator = EmulatorProcess(free_host=True)
    robot = PandaRobot(NetworkedConfig(host=emulator.host))
    goal = np.array([0.6, -0.5, 0.1, -2.2, 0.05, 1.7, 0.9])
    threading.Timer(0.3, emulator.kill).start()
    report = []
    for call in (
        lambda: robot.move_joints(goal, speed=0.005),
        robot.state,
        lambda: robot.grasp(width_m=0.01, force_N=10.0),
        robot.recover,
        robot.stop,
        robot.close,
    ):
        clock = time.monotonic()
        try:
            call()
            report.append(["nothing", "", 0.0])
        except ConnectionLost as error:
            report.append([type(error).__name__, str(error), time.monotonic() - clock])
    print(json.dumps(report))
"""


def test_a_robot_that_goes_away_in_mid_motion_costs_neither_time_nor_the_process(
    tmp_path: Path,
) -> None:
    """In a process of its own: the vendor's destructor would abort it."""
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    done = subprocess.run(
        [sys.executable, script],
        capture_output=True,
        text=True,
        timeout=50,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    *lost, closed = json.loads(done.stdout)
    assert [kind for kind, _, _ in lost] == ["ConnectionLost"] * 5
    assert all("connect anew" in text and seconds < 8.0 for _, text, seconds in lost)
    assert closed[0] == "nothing"
