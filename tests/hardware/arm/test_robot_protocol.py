"""What holds without a robot and without the vendor: imports, errors, planning, the dry run."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from fixtures.places import ROOT
from fixtures.robot_refusals import refuses_what_the_arm_cannot_do
from hypothesis import given, settings
from hypothesis import strategies as st

import hardware
from hardware import (
    ReflexError,
    Robot,
    RobotError,
    RobotMode,
    SafetyViolation,
    UnreachablePose,
    UserStopped,
)
from hardware.arm.arguments import check_joints, check_pose
from hardware.arm.joint_path import path_pieces
from hardware.arm.panda import DQ_MAX, HOME_Q, Q_MAX, Q_MIN, PandaKinematics
from hardware.arm.robot import REFLEX_ADVICE
from hardware.arm.straight_line import distance, straight_line
from hardware.backends.dry_run import DryRunConfig, DryRunRobot, RecordedCommand
from hardware.backends.libfranka_errors import reflex_names, typed_error
from hardware.support.bounded import run_bounded
from warp_deform.errors import InputError, WarpDeformError

HOME = np.array(HOME_Q)
ARM = PandaKinematics()
ERRORS = [
    value
    for name in hardware.__all__
    if isinstance(value := getattr(hardware, name), type) and issubclass(value, RobotError)
]
examples = settings(derandomize=True, deadline=None, max_examples=40)
turns = st.floats(-1.5, 1.5)
moves = st.tuples(st.floats(0.1, 0.2), st.floats(-0.2, 0.2), st.floats(-0.4, 0.05))


def turned_about_z(T: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    turned = T.copy()
    turned[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T[:3, :3]
    return turned


def test_importing_loads_no_vendors_package() -> None:
    script = (
        "import sys, hardware, hardware.backends.panda, hardware.backends.dry_run\n"
        "import hardware.emulator\n"
        "print(sorted({'panda_py', 'franky', 'torch', 'warp'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "[]\n"


# Errors.


@pytest.mark.parametrize("kind", ERRORS)
def test_an_error_is_one_line_that_ends_with_advice(kind: type[RobotError]) -> None:
    error = kind("the arm\n  did something")
    assert isinstance(error, WarpDeformError)
    assert error.advice
    assert str(error) == f"the arm did something; {error.advice}"
    assert str(kind("it broke", advice="mend it")) == "it broke; mend it"


def test_advice_for_programs_says_what_to_do_at_the_prompt_too() -> None:
    kinds = (RobotError, ReflexError, UserStopped)
    advice = [*(kind.default_advice for kind in kinds), *REFLEX_ADVICE.values()]
    assert all("press Enter if asked, else start the command again" in text for text in advice)


@pytest.mark.parametrize("part", REFLEX_ADVICE)
def test_advice_depends_on_the_reflex(part: str) -> None:
    assert ReflexError("stopped", reflexes=(f"some_{part}",)).advice == REFLEX_ADVICE[part]


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        ('Move command aborted: motion aborted by reflex! ["joint_reflex"]', "ReflexError"),
        ("libfranka: Move command aborted: User Stop pressed!", "UserStopped"),
        ('rejected: command not possible in the current mode ("User stopped")!', "UserStopped"),
        ("libfranka: UDP receive: Timeout", "ConnectionLost"),
        ("libfranka: TCP connection got interrupted.", "ConnectionLost"),
        ("libfranka: server closed connection", "ConnectionLost"),
        ("Trajectory generation failed.", "MotionError"),
    ],
)
def test_vendors_messages_become_typed_errors(message: str, kind: str) -> None:
    assert type(typed_error(message, host="robot")) is getattr(hardware, kind)


def test_reflex_names() -> None:
    assert reflex_names('reflex! ["joint_reflex", "cartesian_reflex"]\nrate: 1') == (
        "joint_reflex",
        "cartesian_reflex",
    )


# Commands.


@pytest.mark.parametrize(
    "q", [np.zeros(6), np.zeros((0, 7)), np.zeros((2, 2, 7)), [np.inf] * 7, Q_MAX + 0.01]
)
def test_wrong_joints(q: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"^q: "):
        check_joints(q)


@pytest.mark.parametrize(
    "T", [np.eye(3), -np.eye(4), np.diag([1, 1, -1, 1]), np.diag([1, 1, 1, 2]), np.eye(4) * np.nan]
)
def test_wrong_poses(T: np.ndarray) -> None:
    with pytest.raises(InputError, match="base_T_tcp"):
        check_pose(T)


# Planning.


@examples
@given(move=moves, turn=turns)
def test_a_straight_line_is_straight_and_within_limits(
    move: tuple[float, float, float], turn: float
) -> None:
    start = ARM.pose(HOME)
    target = turned_about_z(start, turn)
    target[:3, 3] += move
    plan = straight_line(ARM, HOME, target, speed=0.1)
    poses = [ARM.pose(q) for q in plan.q]
    off, angle = distance(poses[-1], target)
    assert off < 2e-5 and angle < 2e-4
    for i, pose in enumerate(poses, start=1):
        share = i / len(poses)
        wanted = turned_about_z(start, share * turn)
        wanted[:3, 3] += share * np.array(move)
        off, angle = distance(pose, wanted)
        assert off < 2e-5 and angle < 2e-4
    assert (plan.q > Q_MIN).all() and (plan.q < Q_MAX).all()
    # Half-way between waypoints, where joints are interpolated, too.
    path = np.vstack([HOME, plan.q])
    for a, b in pairwise(path):
        chord = 0.5 * (ARM.pose(a) + ARM.pose(b))[:3, 3]
        assert np.linalg.norm(ARM.pose(0.5 * (a + b))[:3, 3] - chord) < 5e-4
    # At the planned share of the greatest joint speed no step is faster than asked.
    seconds = (np.abs(np.diff(path, axis=0)) / DQ_MAX).max(axis=1) / plan.speed_factor
    lengths = np.linalg.norm(np.diff([ARM.pose(q)[:3, 3] for q in path], axis=0), axis=1)
    assert (lengths <= 0.1 * seconds + 1e-9).all()


def test_many_motions_do_not_let_the_elbow_wander() -> None:
    start, q = ARM.pose(HOME), HOME
    rng = np.random.default_rng(0)
    for _ in range(30):
        target = turned_about_z(start, rng.uniform(-1.2, 1.2))
        target[:3, 3] += rng.uniform([0.0, -0.2, -0.4], [0.2, 0.2, 0.0])
        q = straight_line(ARM, q, target, speed=0.1).q[-1]
        q = straight_line(ARM, q, start, speed=0.1).q[-1]
    assert np.abs(q - HOME).max() < 0.05


@pytest.mark.parametrize("move", [(1.0, 0, 0), (0, 0, 0.5), (-0.25, 0, -0.3)])
def test_an_unreachable_pose(move: tuple[float, float, float]) -> None:
    target = ARM.pose(HOME)
    target[:3, 3] += move
    with pytest.raises(UnreachablePose, match=r"m; choose a pose nearer"):
        straight_line(ARM, HOME, target, speed=0.1)


def test_distance_of_a_half_turn() -> None:
    for axis in np.eye(3):
        T = np.eye(4)
        T[:3, :3] = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert distance(np.eye(4), T) == (0.0, pytest.approx(np.pi))


def test_path_pieces() -> None:
    e, f = 0.3 * np.eye(7)[0], 0.3 * np.eye(7)[1]
    assert path_pieces(HOME, np.array([HOME, HOME])) == []
    (begin, piece), back = path_pieces(HOME, np.array([HOME, HOME + e, HOME + e, HOME, HOME]))
    np.testing.assert_array_equal(begin, HOME)
    np.testing.assert_array_equal(piece, [HOME + e])
    np.testing.assert_array_equal(back[0], HOME + e)
    np.testing.assert_array_equal(back[1], [HOME])
    gentle = np.array([HOME + e, HOME + 2 * e + 0.3 * f, HOME + 3 * e + 0.3 * f])
    assert [len(piece) for _, piece in path_pieces(HOME, gentle)] == [3]
    right_angle = np.array([HOME + e, HOME + e + f])
    assert [len(piece) for _, piece in path_pieces(HOME, right_angle)] == [1, 1]
    dense = HOME + np.linspace(0, 1, 2000)[:, None] * e  # steps below the threshold
    np.testing.assert_array_equal(path_pieces(HOME, dense)[0][1][-1], HOME + e)


# Calls that may hang.


def test_a_bounded_call_hands_on_result_and_error() -> None:
    assert run_bounded(lambda: 42, timeout_s=5.0) == 42
    with pytest.raises(ZeroDivisionError):
        run_bounded(lambda: 1 // 0, timeout_s=5.0)


def test_a_bounded_call_ends_in_time_and_is_stopped() -> None:
    stopped, clock = threading.Event(), time.monotonic()
    with pytest.raises(TimeoutError, match="no answer"):
        run_bounded(lambda: stopped.wait(20.0), timeout_s=0.1, stop=stopped.set)
    assert stopped.is_set() and time.monotonic() - clock < 15.0


def test_ctrl_c_stops_a_bounded_call() -> None:
    stopped, ended = threading.Event(), threading.Event()

    def call() -> None:
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        stopped.wait(20.0)
        time.sleep(0.1)
        ended.set()

    with pytest.raises(KeyboardInterrupt):
        run_bounded(call, timeout_s=20.0, stop=stopped.set)
    assert ended.is_set(), "the call was not waited for"


# The dry run.


def test_dry_run_records_and_reports_where_it_would_be() -> None:
    seen: list[RecordedCommand] = []
    target = turned_about_z(ARM.pose(HOME), 0.3)
    target[:3, 3] += [0.1, 0.1, -0.2]
    with DryRunRobot(on_command=seen.append) as robot:
        assert robot.state().mode == RobotMode.IDLE
        robot.open_gripper()
        result = robot.move_linear(target, speed=0.1, stop_force_N=8.0)
        assert not result.contact
        np.testing.assert_allclose(robot.state().base_T_tcp, target, atol=2e-4)
        assert robot.grasp(width_m=0.005, force_N=10.0)
        assert robot.state().gripper_width_m == 0.004
        robot.move_joints(np.array([HOME, HOME + 0.1]), speed=0.1)
        np.testing.assert_array_equal(robot.state().q, HOME + 0.1)
        robot.stop()
        robot.recover()
    names = ["open_gripper", "move_linear", "grasp", "move_joints", "stop", "recover"]
    assert [command.name for command in seen] == names
    assert robot.commands == seen
    assert seen[1].arguments["stop_force_N"] == 8.0


def test_dry_run_refuses_what_the_arm_would() -> None:
    robot = DryRunRobot(DryRunConfig(object_width_m=0.0))
    assert not robot.grasp(width_m=0.005, force_N=10.0)
    recorded = list(robot.commands)
    refuses_what_the_arm_cannot_do(robot)
    assert robot.commands == recorded


def test_backends_have_the_protocols_methods() -> None:
    from hardware.backends.panda import PandaRobot

    methods = {name for name in vars(Robot) if callable(getattr(Robot, name)) and name[0] != "_"}
    assert methods >= {"state", "move_joints", "move_linear", "open_gripper", "grasp", "close"}
    for backend in (DryRunRobot, PandaRobot):
        assert methods <= set(dir(backend))


def test_a_safety_violation_is_a_robot_error() -> None:
    assert issubclass(SafetyViolation, RobotError)


def test_advice_to_recover_serves_whoever_has_no_python_at_hand() -> None:
    kinds = [RobotError, ReflexError, UserStopped]
    said = [kind("stopped").advice for kind in kinds]
    said += [ReflexError("stopped", reflexes=(name,)).advice for name in REFLEX_ADVICE]
    assert len(said) == 8
    assert [text for text in said if "Enter" not in text or "command again" not in text] == []
