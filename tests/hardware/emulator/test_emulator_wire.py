"""Strangers, wrong bytes, wrong moments on the emulator's sockets: a good client notices none."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from fixtures.emulator_client import libfranka
from fixtures.fci_wire import BUMP, Wire, serves

from hardware.arm.panda import HOME_Q
from hardware.emulator import EmulatorProcess
from hardware.emulator.protocol import (
    GRIPPER_COMMAND_PORT,
    ROBOT_COMMAND_PORT,
    GeneratorMode,
    GripperCommand,
    GripperStatus,
    MoveStatus,
    RobotCommand,
    RobotMode,
    SetStatus,
)

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(120)]
PORTS = (ROBOT_COMMAND_PORT, GRIPPER_COMMAND_PORT)


@pytest.fixture(scope="module")
def host() -> Iterator[str]:
    with EmulatorProcess(free_host=True) as process:
        yield process.host


@pytest.fixture
def robot(host: str) -> Iterator[Wire]:
    """Connected and ready; the emulator serves another one afterwards, whatever was done."""
    with Wire(host) as wire:
        assert wire.connect() == 0
        assert wire.ask(RobotCommand.AUTOMATIC_ERROR_RECOVERY) == 0
        yield wire
    serves(host)


# Bodies and numbers.


def test_a_body_of_8_bytes_is_an_invalid_argument(robot: Wire) -> None:
    status = robot.ask(RobotCommand.SET_COLLISION_BEHAVIOR, bytes(8))
    assert status == SetStatus.INVALID_ARGUMENT


def test_a_frame_of_nan_is_an_invalid_argument(robot: Wire) -> None:
    nan = struct.pack("<16d", *[np.nan] * 16)
    for command in (RobotCommand.SET_NE_TO_EE, RobotCommand.SET_EE_TO_K):
        assert robot.ask(command, nan) == SetStatus.INVALID_ARGUMENT
    assert np.isfinite(robot.state()["O_T_EE"]).all()


def test_the_vendors_client_says_so(host: str) -> None:
    robot = libfranka.Robot(host)
    with pytest.raises(RuntimeError, match=r"Set Joint Impedance .*rejected: invalid argument"):
        robot.set_joint_impedance([np.nan] * 7)
    with pytest.raises(RuntimeError, match=r"Set EE to K .*rejected: invalid argument"):
        robot.set_k([np.inf] * 16)


@pytest.mark.parametrize("size", [0, 1, 9, 4097, 0xFFFFFFFF])
@pytest.mark.parametrize("gripper", [False, True], ids=["robot", "gripper"])
def test_a_header_that_claims_an_impossible_size_drops_the_client(
    host: str, gripper: bool, size: int
) -> None:
    with Wire(host, gripper=gripper) as wire:
        assert wire.connect() == 0
        wire.send(1, size=size)
        assert wire.dropped()


@pytest.mark.parametrize("gripper", [False, True], ids=["robot", "gripper"])
def test_an_unknown_command_drops_the_client(host: str, gripper: bool) -> None:
    with Wire(host, gripper=gripper) as wire:
        assert wire.connect() == 0
        wire.send(77, bytes(40))
        assert wire.dropped()
    serves(host)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize(
    ("generator", "name"),
    [
        (GeneratorMode.JOINT_POSITION, "q_c"),
        (GeneratorMode.JOINT_VELOCITY, "dq_c"),
        (GeneratorMode.CARTESIAN_POSITION, "O_T_EE_c"),
        (GeneratorMode.CARTESIAN_VELOCITY, "O_dP_EE_c"),
    ],
)
def test_a_motion_command_that_is_no_number_is_a_reflex(
    robot: Wire, generator: GeneratorMode, name: str, value: float
) -> None:
    robot.move(generator)
    state = robot.answer(**{name: value})
    assert state["robot_mode"] == RobotMode.REFLEX and state["reflex_reason"].any()
    assert robot.reply()[1] == MoveStatus.REFLEX_ABORTED
    np.testing.assert_allclose(state["q"], HOME_Q, atol=0.1)
    assert not state["dq"].any()


# Who may speak, and when.


@pytest.mark.parametrize("gripper", [False, True], ids=["robot", "gripper"])
def test_commands_before_a_greeting_or_after_a_refused_one_are_not_obeyed(
    host: str, gripper: bool
) -> None:
    body = struct.pack("<2d", 0.01, 0.1) if gripper else bytes(56)
    command = GripperCommand.MOVE if gripper else RobotCommand.MOVE
    with Wire(host, gripper=gripper) as unknown:
        unknown.send(command, body)
        assert unknown.dropped()
    with Wire(host, gripper=gripper) as old:
        assert old.connect(version=1) == 1
        old.send(command, body)
        assert old.dropped()
    with Wire(host, gripper=gripper) as twice:
        assert twice.connect() == 0
        twice.send(0, struct.pack("<2H", 3 if gripper else 5, twice.udp.getsockname()[1]))
        assert twice.dropped()
    with Wire(host, gripper=gripper) as nowhere:
        nowhere.send(0, struct.pack("<2H", 3 if gripper else 5, 0))
        assert nowhere.dropped()
    serves(host)


def test_a_datagram_from_elsewhere_is_not_obeyed(robot: Wire) -> None:
    """From another port, another address, with the right number: the arm follows its client."""
    robot.move()
    for source in ("127.0.0.1", "127.0.0.99"):
        stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        stranger.bind((source, 0))
        stranger.sendto(robot.command(dq_c=2.0), robot.server)
        stranger.close()
    for speed in BUMP:
        state = robot.answer(dq_c=[speed, *[0.0] * 6])
        assert state["robot_mode"] == RobotMode.MOVE
        assert state["dq"][0] == speed


def test_a_datagram_that_answers_another_state_or_is_cut_is_not_obeyed(robot: Wire) -> None:
    robot.move()
    for speed in BUMP:
        ids = (robot.message_id - 1, robot.message_id + 1000, 0, 2**64 - 1)
        for wrong in (*(robot.command(message_id=i, dq_c=2.0) for i in ids), b"", bytes(369)):
            robot.udp.sendto(wrong, robot.server)
        robot.udp.sendto(robot.command(dq_c=2.0) + b"x", robot.server)
        state = robot.answer(dq_c=[speed, *[0.0] * 6])
        assert state["robot_mode"] == RobotMode.MOVE
        assert state["dq"][0] == speed


def test_a_second_move_is_not_possible_and_the_first_goes_on(robot: Wire) -> None:
    robot.move()
    for i, speed in enumerate(BUMP):
        if i == 50:
            assert robot.ask(RobotCommand.MOVE, bytes(56)) == MoveStatus.NOT_POSSIBLE
            status = robot.ask(RobotCommand.SET_JOINT_IMPEDANCE, bytes(56))
            assert status == SetStatus.NOT_POSSIBLE
        state = robot.answer(dq_c=[speed, *[0.0] * 6])
    assert state["robot_mode"] == RobotMode.MOVE and np.abs(state["dq"]).max() < 1e-9
    assert robot.ask(RobotCommand.STOP_MOVE) == SetStatus.SUCCESS
    assert robot.reply()[1] == MoveStatus.PREEMPTED


def test_who_leaves_in_mid_motion_leaves_an_arm_at_rest(host: str) -> None:
    with Wire(host) as robot:
        assert robot.connect() == 0
        robot.ask(RobotCommand.AUTOMATIC_ERROR_RECOVERY)
        robot.move()
        for speed in BUMP[:50]:
            robot.answer(dq_c=[speed, *[0.0] * 6])
    serves(host)


def test_what_a_hand_does_for_who_has_left_is_not_told_to_who_comes(host: str) -> None:
    with Wire(host, gripper=True) as gone:
        assert gone.connect() == 0
        gone.send(GripperCommand.MOVE, struct.pack("<2d", 0.0, 1e-6))
    with Wire(host, gripper=True) as next_one:
        assert next_one.connect() == 0
        body = struct.pack("<2d", 0.05, 0.1)
        assert next_one.ask(GripperCommand.MOVE, body) == GripperStatus.SUCCESS


# Many, slow, deaf.


def test_silent_and_slow_connections_keep_nobody_out(host: str) -> None:
    with_half_a_header = struct.pack("<I", 0)
    crowd = [socket.create_connection((host, port)) for port in PORTS * 30]
    for stranger in crowd[::2]:
        stranger.sendall(with_half_a_header)
    serves(host)
    for stranger in crowd:
        stranger.close()


def test_a_client_that_does_not_read_is_dropped(host: str) -> None:
    with Wire(host) as deaf:
        assert deaf.connect() == 0
        deaf.tcp.settimeout(0.2)
        with pytest.raises(OSError):
            while True:
                deaf.send(RobotCommand.LOAD_MODEL_LIBRARY, b"\x00\x00")
    serves(host)


def test_a_request_may_come_byte_by_byte(host: str) -> None:
    with Wire(host) as slow:
        hello = struct.pack("<III2H", 0, 1, 16, 5, slow.udp.getsockname()[1])
        for i in range(len(hello)):
            slow.tcp.sendall(hello[i : i + 1])
        assert slow.reply()[:2] == (1, 0)


# Any bytes at all.


def test_after_any_bytes_the_emulator_serves(host: str) -> None:
    """Random bytes, and requests with random fields, before and after a greeting, on both ports."""
    rng = np.random.default_rng(20)
    for trial in range(120):
        with Wire(host, gripper=trial % 2 == 1) as wire:
            try:
                server = None
                if trial % 3:
                    assert wire.connect() == 0
                    if trial % 2 == 0:
                        wire.state()
                        server = wire.server
                if trial % 4 == 0:
                    wire.tcp.sendall(rng.bytes(int(rng.integers(1, 3000))))
                else:
                    for _ in range(10):
                        size = int(rng.choice([0, 4, 8, 16, 56, 128, 416, 4000]))
                        wire.send(int(rng.integers(0, 14)), rng.bytes(size))
                        if server is not None:
                            wire.udp.sendto(rng.bytes(int(rng.integers(0, 800))), server)
                wire.tcp.shutdown(socket.SHUT_WR)
                while wire.tcp.recv(65536):
                    pass  # until the server has read everything
            except TimeoutError:
                raise
            except OSError:
                pass  # it has dropped this connection: its right
        if trial % 30 == 29:
            serves(host)
