"""What the emulated Panda is made of: its protocol's bytes, its model, its gripper."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from hardware.arm.panda import HOME_Q, Q_MAX, Q_MIN, PandaKinematics, flange_T_tcp
from hardware.emulator.arm import Arm
from hardware.emulator.gripper import Gripper
from hardware.emulator.model_library import CompilerMissing, find_compiler, model_library
from hardware.emulator.protocol import (
    ROBOT_COMMAND,
    ROBOT_STATE,
    ControllerMode,
    GeneratorMode,
    GripperCommand,
    GripperStatus,
    Request,
    Stream,
)

HOME = np.array(HOME_Q)

# The bytes.


def test_datagrams_have_the_vendors_sizes() -> None:
    assert (ROBOT_STATE.itemsize, ROBOT_COMMAND.itemsize) == (2373, 370)


@pytest.mark.parametrize("cut", [1, 7, 12, 13, 40])
def test_stream_cuts_requests_wherever_the_network_did(cut: int) -> None:
    sent = [Request(1, 5, b"abc"), Request(2, 6, b""), Request(12, 7, b"x" * 30)]
    data = b"".join(struct.pack("<III", c, i, 12 + len(b)) + b for c, i, b in sent)
    stream = Stream(command="I", status="B")
    parts = [data[i : i + cut] for i in range(0, len(data), cut)]
    assert [request for part in parts for request in stream.requests(part)] == sent
    assert stream.reply(1, 5, 6, b"zz") == struct.pack("<IIIB", 1, 5, 15, 6) + b"zz"


@pytest.mark.parametrize("size", [0, 11, 5000])
def test_stream_refuses_what_is_no_request(size: int) -> None:
    with pytest.raises(ValueError, match="bytes"):
        list(Stream(command="I", status="B").requests(struct.pack("<III", 1, 1, size)))


# The model.


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_model_library_agrees_with_numpy() -> None:
    model, arm = model_library(), PandaKinematics()
    F_T_EE = flange_T_tcp().T.ravel()
    for q in np.random.default_rng(0).uniform(Q_MIN, Q_MAX, (20, 7)):
        pose = model.pose(q, F_T_EE).reshape(4, 4).T
        np.testing.assert_allclose(pose, arm.pose(q), atol=1e-12)
        np.testing.assert_allclose(model.jacobian(q, F_T_EE), arm.jacobian(q), atol=1e-12)


def test_jacobian_is_the_derivative_of_the_pose() -> None:
    arm, step = PandaKinematics(), 1e-6
    for q in np.random.default_rng(1).uniform(Q_MIN, Q_MAX, (5, 7)):
        for joint, column in enumerate(arm.jacobian(q).T):
            nudge = step * np.eye(7)[joint]
            rate = (arm.pose(q + nudge) - arm.pose(q - nudge)) / (2 * step)
            W = rate[:3, :3] @ arm.pose(q)[:3, :3].T
            turning = [W[2, 1], W[0, 2], W[1, 0]]
            np.testing.assert_allclose(column, [*rate[:3, 3], *turning], atol=1e-8)


def follow(commands: np.ndarray, *, generator: str, controller: str, q: np.ndarray = HOME) -> str:
    """The names of the limits that a sequence of commands violates, or "none"."""
    arm = Arm(model_library(), q=q)
    modes = {"generator": GeneratorMode[generator], "controller": ControllerMode[controller]}
    for i, command in enumerate(commands):
        names = arm.follow(command, first=i == 0, **modes)
        if names:
            return " ".join(names)
    return "none"


def ramp(name: str, start: np.ndarray, rate: np.ndarray, ticks: int) -> np.ndarray:
    """Commands whose field `name` grows from `start` by `rate` a second."""
    commands = np.zeros(ticks, ROBOT_COMMAND)
    commands[name] = start + np.outer(1e-3 * np.arange(1, ticks + 1), rate)
    return commands


UNIT = np.eye(7)
NEAR_LIMIT = HOME + (Q_MAX[0] - 0.01) * UNIT[0]


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    ("commands", "q", "violation"),
    [
        (ramp("tau_J_d", 0 * UNIT[0], 20 * UNIT[0], 300), HOME, "none"),
        (ramp("tau_J_d", 0 * UNIT[0], 999 * UNIT[0], 100), HOME, "joint_velocity_violation"),
        (ramp("tau_J_d", 0 * UNIT[6], 900 * UNIT[6], 20), HOME, "tau_J_range_violation"),
        (ramp("tau_J_d", 5 * UNIT[0], 0 * UNIT[0], 2), HOME, "controller_torque_discontinuity"),
        (
            ramp("tau_J_d", 0 * UNIT[0], 50 * UNIT[0], 300),
            NEAR_LIMIT,
            "joint_position_limits_violation",
        ),
        (ramp("tau_J_d", np.nan * UNIT[0], 0 * UNIT[0], 2), HOME, "tau_J_range_violation"),
    ],
)
def test_limits_of_torques(commands: np.ndarray, q: np.ndarray, violation: str) -> None:
    found = follow(commands, generator="JOINT_VELOCITY", controller="EXTERNAL", q=q)
    assert found == violation


TWIST = np.eye(6)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    ("twist", "violation"),
    [
        (ramp("O_dP_EE_c", 0 * TWIST[1], 0.5 * TWIST[1], 300), "none"),
        (ramp("O_dP_EE_c", 0 * TWIST[2], 0.5 * TWIST[5], 300), "none"),
        (
            ramp("O_dP_EE_c", 0 * TWIST[1], 14 * TWIST[1], 300),
            "cartesian_motion_generator_velocity_discontinuity "
            "cartesian_motion_generator_acceleration_discontinuity",
        ),
    ],
)
def test_limits_of_twists(twist: np.ndarray, violation: str) -> None:
    found = follow(twist, generator="CARTESIAN_VELOCITY", controller="JOINT_IMPEDANCE")
    assert found == violation


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_limits_of_poses() -> None:
    def found(T: np.ndarray) -> str:
        command = np.zeros(1, ROBOT_COMMAND)
        command["O_T_EE_c"] = T.T.ravel()
        return follow(command, generator="CARTESIAN_POSITION", controller="JOINT_IMPEDANCE")

    here = PandaKinematics().pose(HOME)
    assert found(here) == "none"
    skewed, away = here.copy(), here.copy()
    skewed[0, 0] += 0.01
    away[0, 3] += 0.01
    assert found(skewed) == "cartesian_position_motion_generator_invalid_frame_flag"
    assert found(away) == "cartesian_position_motion_generator_start_pose_invalid"


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(CompilerMissing, match="install one"):
        model_library.__wrapped__()


# The gripper.


def finish(gripper: Gripper, request: Request, object_width: float = 0.0) -> tuple[int, float]:
    """Run a command to its end; returns its status and how many seconds it took."""
    assert gripper.start(request) == []
    for tick in range(1, 100_000):
        ended = gripper.step(1e-3, object_width)
        if ended is not None:
            assert ended[0] is request
            return ended[1], tick * 1e-3
    raise AssertionError("the command never ended")


def move(width: float, speed: float) -> Request:
    return Request(GripperCommand.MOVE, 1, struct.pack("<2d", width, speed))


def grasp(width: float, inner: float, outer: float) -> Request:
    return Request(GripperCommand.GRASP, 2, struct.pack("<5d", width, inner, outer, 0.05, 10.0))


def test_fingers_move_at_their_speed() -> None:
    gripper = Gripper(width=0.08)
    assert finish(gripper, move(0.03, 0.1)) == (GripperStatus.SUCCESS, pytest.approx(0.5))
    assert gripper.width == 0.03
    status, seconds = finish(gripper, Request(GripperCommand.HOMING, 3, b""))
    assert (status, gripper.width) == (GripperStatus.SUCCESS, 0.08)
    assert seconds == pytest.approx(0.11 / 0.05, abs=2e-3)


def test_fingers_stop_at_an_object() -> None:
    gripper = Gripper(width=0.08)
    assert finish(gripper, move(0.0, 0.1), 0.02)[0] == GripperStatus.UNSUCCESSFUL
    assert gripper.width == 0.02
    assert finish(gripper, move(0.05, 0.1), 0.02)[0] == GripperStatus.SUCCESS


@pytest.mark.parametrize(
    ("object_width", "tolerance", "status"),
    [
        (0.006, (0.005, 0.005), GripperStatus.SUCCESS),
        (0.0, (0.005, 0.005), GripperStatus.UNSUCCESSFUL),
        (0.02, (0.005, 0.005), GripperStatus.UNSUCCESSFUL),
        (0.0, (0.08, 0.08), GripperStatus.SUCCESS),
    ],
)
def test_grasp_succeeds_within_its_tolerance(
    object_width: float, tolerance: tuple[float, float], status: GripperStatus
) -> None:
    gripper = Gripper(width=0.08)
    assert finish(gripper, grasp(0.006, *tolerance), object_width)[0] == status
    assert gripper.width == object_width
    assert gripper.grasped == (status == GripperStatus.SUCCESS)


@pytest.mark.parametrize("request_", [move(0.2, 0.1), move(0.05, 0.0), Request(2, 1, b"short")])
def test_an_impossible_finger_command_fails_at_once(request_: Request) -> None:
    assert Gripper(width=0.08).start(request_) == [(request_, GripperStatus.FAIL)]


def test_a_stop_aborts_what_the_fingers_do() -> None:
    gripper = Gripper(width=0.08)
    moving, stop = move(0.0, 0.01), Request(GripperCommand.STOP, 2, b"")
    gripper.start(moving)
    gripper.step(1e-3, 0.0)
    ended = gripper.start(stop)
    assert ended == [(moving, GripperStatus.ABORTED), (stop, GripperStatus.SUCCESS)]
    assert not gripper.busy


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (
            "echo 'model.c:2:10: fatal error: math.h: No such file' >&2; exit 1",
            "fatal error: math.h",
        ),
        ("exit 4", "exit code 4"),
    ],
)
def test_a_compiler_without_headers_is_as_good_as_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str, message: str
) -> None:
    compiler = tmp_path / "gcc"
    compiler.write_text(f"#!/bin/sh\n{script}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_compiler() == str(compiler)
    with pytest.raises(CompilerMissing, match=rf"{message}.*; install one") as caught:
        model_library.__wrapped__()
    assert "\n" not in str(caught.value)
