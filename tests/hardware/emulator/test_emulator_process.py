"""The emulated Panda as a process: its clock, its clients, its user stop, its end."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.emulator_client import HOME, OFF_HOME, libfranka, timed, vendor_client
from fixtures.emulator_worlds import RecordingWorld
from fixtures.places import ROOT

from hardware.emulator import EmulatorFailed, EmulatorProcess, TableWorld
from hardware.emulator.model_library import model_library
from hardware.emulator.server import AddressTaken, EmulatorConfig, FciServer
from warp_deform.errors import InputError
from warp_deform.xpbd.guards import PhysicsError, Problem, ProblemKind

pytestmark = pytest.mark.emulator


# User stop, time, and the process.


def test_user_stop_until_it_is_released_and_recovered_from(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    emulator.user_stop()
    with pytest.raises(RuntimeError, match="rejected"):
        panda.robot.automatic_error_recovery()
    assert not panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)
    np.testing.assert_array_equal(emulator.snapshot()["q"], HOME)
    emulator.user_stop(False)
    assert emulator.snapshot()["mode"] == "idle"
    assert not panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)
    with pytest.raises(RuntimeError, match="not possible in the current mode"):
        panda.panda.raise_error()
    np.testing.assert_array_equal(emulator.snapshot()["q"], HOME)
    panda.robot.automatic_error_recovery()
    assert panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)


def scripted_run() -> dict[str, object]:
    """Motions, a grasp, a reflex and its recovery in a fresh emulator; returns where it ended."""
    with EmulatorProcess(world=RecordingWorld, free_host=True) as emulator:
        with vendor_client(emulator.host) as client:
            client.panda.move_to_joint_position(OFF_HOME, speed_factor=0.3)
            emulator.call_world("place_object", width=0.01)
            client.gripper.grasp(0.01, 0.05, 10.0)
            emulator.inject_reflex("joint_reflex", after_ticks=150)
            client.panda.move_to_start(speed_factor=0.3)
            client.panda.recover()
            client.panda.move_to_start(speed_factor=0.5)
        return {**emulator.snapshot(), "trace": emulator.call_world("take")}


def test_lock_step_gives_the_same_bits_twice() -> None:
    once, again = scripted_run(), scripted_run()
    for key in ("q", "base_T_tcp"):
        assert once[key].tobytes() == again[key].tobytes()
    for key in ("ticks", "missed", "sim_seconds", "gripper_width"):
        assert once[key] == again[key]
    for key, values in once["trace"].items():
        assert values.tobytes() == again["trace"][key].tobytes(), key
    assert once["ticks"] > 1000


def test_lock_step_time_is_what_was_answered(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    before = emulator.snapshot()
    assert panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)
    after = emulator.snapshot()
    ticks = after["ticks"] - before["ticks"]
    assert ticks > 500 and after["missed"] == before["missed"]
    assert after["sim_seconds"] - before["sim_seconds"] == pytest.approx(ticks * 1e-3, abs=1e-9)


def test_lock_step_waits_for_a_client_that_a_busy_machine_holds_up(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    def make(t: float, state: object) -> object:
        if 0.1 < t < 0.1015:
            time.sleep(1.5)
        return libfranka.JointPositions(list(state.q_d))

    before = emulator.snapshot()
    panda.robot.control_joint_position(timed(make, seconds=0.2))
    after = emulator.snapshot()
    assert after["missed"] == before["missed"] and after["mode"] == "idle"
    assert after["sim_seconds"] - before["sim_seconds"] < 0.3


@pytest.fixture(scope="module")
def paced() -> Iterator[EmulatorProcess]:
    with EmulatorProcess(EmulatorConfig(paced=True), free_host=True) as process:
        yield process


@pytest.fixture
def arm(paced: EmulatorProcess) -> Iterator[SimpleNamespace]:
    """A client of the paced robot, ready to move; let go of whatever becomes of the test."""
    client = SimpleNamespace(robot=libfranka.Robot(paced.host))
    if client.robot.read_once().robot_mode == libfranka.RobotMode.kReflex:
        client.robot.automatic_error_recovery()
    try:
        yield client
    finally:
        vars(client).clear()


def unhindered(robot: object, make: Callable[[float, object], object], seconds: float) -> None:
    """Move a paced robot, again where the machine is so busy that it loses its client for 20 ms."""
    for _ in range(20):
        try:
            return robot.control_joint_position(timed(make, seconds=seconds))
        except RuntimeError as error:
            if "communication_constraints_violation" not in str(error):
                raise
            robot.automatic_error_recovery()
    pytest.fail("the machine holds every motion up")


def still(t: float, state: object) -> object:
    return libfranka.JointPositions(list(state.q_d))


def test_paced_time_never_runs_ahead_of_the_wall_clock(paced: EmulatorProcess) -> None:
    clock, first, passed = time.perf_counter(), paced.snapshot()["sim_seconds"], 0.0
    while passed < 0.3:
        assert time.perf_counter() - clock < 60.0, "its time stands still"
        passed = paced.snapshot()["sim_seconds"] - first
    assert passed < time.perf_counter() - clock + 0.02


def test_paced_time_catches_up_after_a_short_delay_and_lets_a_long_one_pass() -> None:
    config = EmulatorConfig(host="127.0.78.3", paced=True)
    server = FciServer(config, model=model_library(), world=TableWorld())
    try:
        now = server._next_tick

        def pass_in(seconds: float) -> float:
            """The simulated time that a delay brings, however often the loop then comes round."""
            nonlocal now
            now, before = now + seconds, server.sim_seconds
            for _ in range(50):
                server._advance(now)
            return server.sim_seconds - before

        server._advance(now)
        assert sum(pass_in(1e-3) for _ in range(200)) == pytest.approx(0.2, abs=1.5e-3)
        assert pass_in(5e-3) == pytest.approx(5e-3, abs=1.5e-3)
        assert pass_in(0.3) == pytest.approx(0.011, abs=1.5e-3)
        assert sum(pass_in(1e-3) for _ in range(100)) == pytest.approx(0.1, abs=1.5e-3)
    finally:
        server.close()


def test_a_silent_client_loses_the_robot(arm: SimpleNamespace) -> None:
    def make(t: float, state: object) -> object:
        if t > 0.005:
            time.sleep(0.2)
        return still(t, state)

    with pytest.raises(RuntimeError, match="communication_constraints_violation"):
        arm.robot.control_joint_position(timed(make, seconds=1.0))
    arm.robot.automatic_error_recovery()


def test_a_client_that_goes_away_in_mid_motion_leaves_a_robot_for_the_next(
    paced: EmulatorProcess, arm: SimpleNamespace
) -> None:
    def leave(t: float, state: object) -> object:
        if t > 0.005:
            raise ValueError("gone")
        return still(t, state)

    with pytest.raises(ValueError, match="gone"):
        unhindered(arm.robot, leave, seconds=1.0)
    vars(arm).clear()
    until = time.monotonic() + 20.0
    while paced.snapshot()["mode"] == "move" and time.monotonic() < until:
        time.sleep(0.01)
    robot = libfranka.Robot(paced.host)
    if robot.read_once().robot_mode == libfranka.RobotMode.kReflex:
        robot.automatic_error_recovery()
    unhindered(robot, still, seconds=0.05)


def test_a_second_client_is_turned_away(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    with pytest.raises(RuntimeError, match="libfranka"):
        libfranka.Robot(emulator.host)
    assert panda.robot.read_once().q[0] == HOME[0]


def test_bytes_that_are_no_request_drop_the_client(paced: EmulatorProcess) -> None:
    with socket.create_connection((paced.host, 1337), timeout=5.0) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert stranger.recv(100) == b""
    libfranka.Robot(paced.host)


def test_a_world_is_made_in_the_emulators_process() -> None:
    world = partial(TableWorld, object_width=0.02)
    with (
        EmulatorProcess(world=world, free_host=True) as emulator,
        vendor_client(emulator.host) as client,
    ):
        assert not client.gripper.move(0.0, 0.1)
        assert emulator.snapshot()["gripper_width"] == 0.02


def test_an_address_serves_one_emulator(emulator: EmulatorProcess) -> None:
    with pytest.raises(AddressTaken, match="cannot listen on 127"):
        EmulatorProcess(EmulatorConfig(host=emulator.host))


def test_questions_that_have_no_answer(emulator: EmulatorProcess) -> None:
    with pytest.raises(InputError, match="reflex: one of"):
        emulator.inject_reflex("no_such_reflex")
    with pytest.raises(InputError, match="no method 'dance'"):
        emulator.call_world("dance")
    with pytest.raises(InputError, match="seven finite"):
        emulator.place(np.full(7, np.nan))
    with pytest.raises(InputError, match="seven"):
        EmulatorConfig(q=(0.0,))
    with pytest.raises(InputError, match="seven finite"):
        EmulatorConfig(q=(np.nan,) * 7)
    with pytest.raises(InputError, match="version: 0 to 65535"):
        EmulatorConfig(version=70000)
    with pytest.raises(InputError, match="gripper_width"):
        EmulatorConfig(gripper_width=0.5)
    with pytest.raises(InputError, match="object_width"):
        TableWorld(object_width=0.1)


def test_a_world_that_fails_is_an_answer_and_not_the_end(emulator: EmulatorProcess) -> None:
    with pytest.raises(PhysicsError) as caught:
        emulator.call_world("overstretch")
    problem = Problem(ProblemKind.STRETCH, 0, 2.0, 1.5)
    assert caught.value.problems == (problem,) and str(caught.value) == str(problem)
    assert emulator.snapshot()["mode"] == "idle"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.0.7", "example.org", ""])
def test_only_this_machine_is_served(host: str) -> None:
    with pytest.raises(InputError, match=r"not an address of this machine alone.*127\.0\.0\.1"):
        EmulatorConfig(host=host)


def test_an_emulator_that_is_too_slow_or_killed_says_so() -> None:
    with pytest.raises(EmulatorFailed, match=r"did not start in 0\.01 s; give it longer"):
        EmulatorProcess(free_host=True, start_timeout_s=0.01)
    process = EmulatorProcess(free_host=True)
    os.kill(process._process.pid, signal.SIGSTOP)
    try:
        with pytest.raises(EmulatorFailed, match=r"did not answer 'world' in 0\.1 s; give it"):
            process.call_world("place_object", timeout_s=0.1, width=0.0)
    finally:
        process.kill()
    with pytest.raises(EmulatorFailed, match=r"has ended; .*start another"):
        process.snapshot()
    process.close()


def test_command_line() -> None:
    """Serves until it is interrupted."""
    command = [sys.executable, "-m", "warp_deform", "franka", "emulate"]
    running = subprocess.Popen(
        [*command, "--host", "127.0.78.1"], stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    watchdog = threading.Timer(120.0, running.kill)
    watchdog.start()
    try:
        assert "emulated Panda serves 127.0.78.1" in running.stderr.readline()
        until = time.monotonic() + 20.0
        while True:
            try:
                libfranka.Robot("127.0.78.1")
                break
            except RuntimeError:
                assert time.monotonic() < until
                time.sleep(0.05)
        running.send_signal(2)
        assert running.wait(60.0) == 0
    finally:
        watchdog.cancel()
        running.kill()
        running.stderr.close()
        running.wait()
