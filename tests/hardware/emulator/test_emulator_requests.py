"""What the emulated robot refuses, by the protocol's own status, and that it harms nothing."""

from __future__ import annotations

import shutil
import struct

import numpy as np
import pytest
from fixtures.fci_wire import DEVIATIONS
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.arm.panda import HOME_Q, flange_T_tcp
from hardware.emulator.frames import difference, is_frame, moved_on
from hardware.emulator.gripper import Gripper
from hardware.emulator.model_library import model_library
from hardware.emulator.protocol import (
    ROBOT_COMMAND,
    GripperCommand,
    GripperStatus,
    MoveStatus,
    Request,
    RobotCommand,
    RobotMode,
    SetStatus,
    Stream,
)
from hardware.emulator.requests import GRIPPER_FORMS, ROBOT_FORMS, read
from hardware.emulator.robot import EmulatedRobot

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
FRAME = flange_T_tcp().T.ravel()
# Of every command with numbers, some that are right.
RIGHT = {
    RobotCommand.MOVE: struct.pack("<2I", 0, 1) + DEVIATIONS,
    RobotCommand.SET_COLLISION_BEHAVIOR: struct.pack("<52d", *[20.0] * 52),
    RobotCommand.SET_JOINT_IMPEDANCE: struct.pack("<7d", *[3000.0] * 7),
    RobotCommand.SET_CARTESIAN_IMPEDANCE: struct.pack("<6d", *[300.0] * 6),
    RobotCommand.SET_EE_TO_K: struct.pack("<16d", *FRAME),
    RobotCommand.SET_NE_TO_EE: struct.pack("<16d", *FRAME),
    RobotCommand.SET_LOAD: struct.pack("<13d", 0.1, *[0.0] * 12),
    RobotCommand.SET_FILTERS: struct.pack("<5d", *[100.0] * 5),
}
OTHERS = {
    RobotCommand.STOP_MOVE: b"",
    RobotCommand.GET_CARTESIAN_LIMIT: bytes(4),
    RobotCommand.SET_GUIDING_MODE: bytes(7),
    RobotCommand.AUTOMATIC_ERROR_RECOVERY: b"",
}
OF_FINGERS = {
    GripperCommand.MOVE: struct.pack("<2d", 0.03, 0.1),
    GripperCommand.GRASP: struct.pack("<5d", 0.03, 0.005, 0.005, 0.1, 20.0),
}


def robot() -> EmulatedRobot:
    return EmulatedRobot(model_library(), q=np.array(HOME_Q))


def status(robot: EmulatedRobot, command: int, body: bytes) -> int:
    return robot.obey(Request(command, 1, body))[0].status


def spoilt(body: bytes, index: int, value: float) -> bytes:
    """The body with its double number `index`, counted from the end, replaced."""
    numbers = bytearray(body)
    struct.pack_into("<d", numbers, len(body) - 8 * (index + 1), value)
    return bytes(numbers)


def test_commands_that_are_right_are_accepted() -> None:
    for command, body in {**OTHERS, **RIGHT}.items():
        accepted = MoveStatus.MOTION_STARTED if command == RobotCommand.MOVE else SetStatus.SUCCESS
        assert status(robot(), command, body) == accepted, command


@pytest.mark.parametrize("command", ROBOT_FORMS)
def test_a_body_of_another_length_is_refused_and_changes_nothing(command: int) -> None:
    arm = robot()
    before = arm.state(0)
    right = ROBOT_FORMS[command].layout.size
    for length in {0, 1, 8, right - 1, right + 1, right + 8, 2 * right, 4000} - {-1, right}:
        assert status(arm, command, bytes(length)) == ROBOT_FORMS[command].refusal, length
        assert arm.state(0) == before


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("command", RIGHT)
def test_numbers_that_are_none_are_refused_wherever_they_stand(command: int, value: float) -> None:
    arm = robot()
    before = arm.state(0)
    for index in range(len(RIGHT[command]) // 8 - (command == RobotCommand.MOVE)):
        body = spoilt(RIGHT[command], index, value)
        assert status(arm, command, body) == ROBOT_FORMS[command].refusal, index
    assert arm.state(0) == before and not arm.moving


@pytest.mark.parametrize(
    ("command", "body"),
    [
        (RobotCommand.SET_JOINT_IMPEDANCE, struct.pack("<7d", *[14251.0] * 7)),
        (RobotCommand.SET_CARTESIAN_IMPEDANCE, struct.pack("<6d", 9.0, *[10.0] * 5)),
        (RobotCommand.SET_CARTESIAN_IMPEDANCE, struct.pack("<6d", *[10.0] * 5, 301.0)),
        (RobotCommand.SET_FILTERS, struct.pack("<5d", *[0.0] * 5)),
        (RobotCommand.SET_GUIDING_MODE, b"\x02" + bytes(6)),
        (RobotCommand.SET_EE_TO_K, struct.pack("<16d", *np.diag([1.0, 1, -1, 1]).ravel())),
        (RobotCommand.SET_NE_TO_EE, bytes(128)),
        (RobotCommand.LOAD_MODEL_LIBRARY, b"\x00\x01"),
        (RobotCommand.MOVE, struct.pack("<2I", 3, 1) + DEVIATIONS),
        (RobotCommand.MOVE, struct.pack("<2I", 0, 4) + DEVIATIONS),
        (RobotCommand.MOVE, struct.pack("<2I", 0, 0xFFFFFFFF) + DEVIATIONS),
    ],
)
def test_what_the_robot_does_not_offer_is_refused(command: int, body: bytes) -> None:
    assert status(robot(), command, body) == ROBOT_FORMS[command].refusal


def test_commands_in_the_wrong_state_are_not_possible() -> None:
    arm = robot()
    assert status(arm, RobotCommand.STOP_MOVE, b"") == SetStatus.SUCCESS  # nothing to stop
    assert status(arm, RobotCommand.MOVE, RIGHT[RobotCommand.MOVE]) == MoveStatus.MOTION_STARTED
    assert status(arm, RobotCommand.MOVE, RIGHT[RobotCommand.MOVE]) == MoveStatus.NOT_POSSIBLE
    for command, body in RIGHT.items():
        if command != RobotCommand.MOVE:
            assert status(arm, command, body) == SetStatus.NOT_POSSIBLE
    assert status(arm, RobotCommand.AUTOMATIC_ERROR_RECOVERY, b"") == SetStatus.NOT_POSSIBLE
    assert arm.moving and arm.mode == RobotMode.MOVE
    stopped = arm.obey(Request(RobotCommand.STOP_MOVE, 7, b""))
    assert [answer.status for answer in stopped] == [SetStatus.SUCCESS, MoveStatus.PREEMPTED]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0])
@pytest.mark.parametrize("command", OF_FINGERS)
def test_the_hand_refuses_such_numbers_and_goes_on_with_what_it_does(
    command: int, value: float
) -> None:
    gripper = Gripper(width=0.08)
    under_way = Request(GripperCommand.MOVE, 1, struct.pack("<2d", 0.01, 0.1))
    assert gripper.start(under_way) == []
    for index in range(len(OF_FINGERS[command]) // 8):
        wrong = Request(command, 2, spoilt(OF_FINGERS[command], index, value))
        assert gripper.start(wrong) == [(wrong, GripperStatus.FAIL)]
    for length in {0, 1, 8, 17, 4000}:
        wrong = Request(command, 3, bytes(length))
        assert gripper.start(wrong) == [(wrong, GripperStatus.FAIL)]
    assert gripper.busy
    after = Request(command, 4, OF_FINGERS[command])
    assert gripper.start(after) == [(under_way, GripperStatus.ABORTED)]


@pytest.mark.parametrize("forms", [ROBOT_FORMS, GRIPPER_FORMS], ids=["robot", "gripper"])
def test_a_command_that_does_not_exist_is_none(forms: dict) -> None:
    for command in (0, 14, 99, 0xFFFF):
        with pytest.raises(ValueError, match=f"number {command}"):
            read(Request(command, 1, bytes(40)), forms)


# Any bytes.


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    commands=st.lists(st.tuples(st.sampled_from([*ROBOT_FORMS]), st.binary(max_size=140))),
    datagrams=st.lists(
        st.binary(min_size=ROBOT_COMMAND.itemsize, max_size=ROBOT_COMMAND.itemsize), max_size=8
    ),
    modes=st.tuples(st.sampled_from(range(3)), st.sampled_from(range(4))),
)
def test_no_bytes_leave_the_arm_anywhere_but_at_a_place(
    commands: list[tuple[int, bytes]], datagrams: list[bytes], modes: tuple[int, int]
) -> None:
    """A request of any content, then a motion of any content: an answer to each, and an arm."""
    arm = robot()
    for command, body in commands:
        answers = arm.obey(Request(command, 1, body))
        assert answers and all(0 <= answer.status < 256 for answer in answers)
    arm.disconnect()
    arm.obey(Request(RobotCommand.AUTOMATIC_ERROR_RECOVERY, 1, b""))
    move = Request(RobotCommand.MOVE, 1, struct.pack("<2I", *modes) + DEVIATIONS)
    assert arm.obey(move)[0].status == MoveStatus.MOTION_STARTED
    ended = [answer for answer in map(arm.tick, datagrams) if answer is not None]
    assert len(ended) <= 1
    assert all(answer.status in (MoveStatus.REFLEX_ABORTED, MoveStatus.SUCCESS) for answer in ended)
    assert np.abs(arm.arm.q - HOME_Q).max() < 1e-2
    assert np.isfinite(np.frombuffer(arm.state(1)[8:2000], "<f8")).all()


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(st.binary(max_size=64), max_size=20))
def test_a_stream_of_any_bytes_ends_or_yields_requests(parts: list[bytes]) -> None:
    stream = Stream(command="I", status="B")
    try:
        for request in (request for part in parts for request in stream.requests(part)):
            assert len(request.body) <= Stream.LONGEST
    except ValueError:
        pass  # the server drops such a connection
    assert len(stream._pending) <= Stream.LONGEST + 64


# Frames.


def test_frames_are_frames() -> None:
    assert is_frame(FRAME)
    for index in range(16):
        for change in (1e-3, np.nan, np.inf):
            wrong = FRAME.copy()
            wrong[index] += change
            assert is_frame(wrong) == (index in (12, 13, 14) and change == 1e-3)


def test_a_frame_moved_on_is_as_far_as_it_was_moved() -> None:
    rng = np.random.default_rng(0)
    T = FRAME.reshape(4, 4).T
    for size in (1e-9, 1e-4, 1e-2, 1.0, 1.8):
        step = size * rng.uniform(-1.0, 1.0, 6)
        np.testing.assert_allclose(difference(T, moved_on(T, step)), step, atol=1e-15 + 1e-9 * size)
        assert is_frame(moved_on(T, step).T.ravel())
