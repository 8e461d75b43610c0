"""Stops that hold, arguments that are none, limits that stay, threads that take turns."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fixtures.safety_spy import ARM, HOME, SpyRobot, pose
from fixtures.watched_sim import watched

from hardware import MotionError, RobotError
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import DQ_MAX
from hardware.arm.pick_place import PickPlaceAction, PickPlaceConfig
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.stop_latch import StopLatch
from hardware.arm.table_plane import TablePlane
from hardware.backends.dry_run import DryRunRobot
from hardware.emulator.world import TableWorld
from hardware.twin.robot import SimRobot
from warp_deform.errors import InputError

FLAT = SafetyLimits(table=TablePlane(0.0))
FAST = replace(FLAT, max_joint_speed=0.2)


# Arguments that are none.

JUNK: list[Any] = [
    0.0,
    -1.0,
    float("nan"),
    float("inf"),
    1e-300,
    True,
    None,
    "0.05",
    1j,
    [0.05],
    np.array([0.05]),
    {},
    10**400,
]


@pytest.mark.parametrize("junk", JUNK, ids=[repr(junk)[:12] for junk in JUNK])
def test_numbers_that_are_none_are_refused_by_name(junk: object) -> None:
    robot, spy = SafeRobot(spy := SpyRobot(), FLAT), spy
    calls: list[tuple[str, Callable[[], object]]] = [
        ("speed", lambda: robot.move_linear(pose(), speed=junk)),
        ("speed", lambda: robot.move_joints(HOME, speed=junk)),
        ("width_m", lambda: robot.open_gripper(junk)),
        ("width_m", lambda: robot.grasp(width_m=junk, force_N=5.0)),
        ("force_N", lambda: robot.grasp(width_m=0.01, force_N=junk)),
        ("speed", lambda: robot.check_lines([(pose(), junk, None)])),
    ]
    if junk is not None:  # which stands for the default
        calls.append(("speed", lambda: robot.home(speed=junk)))
        calls.append(("force", lambda: robot.move_linear(pose(), speed=0.05, stop_force_N=junk)))
    for name, call in calls:
        with pytest.raises((InputError, RobotError), match=name) as refused:
            call()
        assert "\n" not in str(refused.value)
    assert spy.log == ["recover"]


@pytest.mark.parametrize(
    "bent",
    [
        pose() * 1j,
        pose().astype(str),
        pose()[:3],
        None,
        "here",
        [[1.0], [1.0, 2.0]],
        np.eye(4, dtype=bool),
        1.001 * pose(),
        pose() * 1e200,
        np.full((4, 4), np.inf),
        object,
    ],
    ids=str,
)
def test_poses_that_are_none_are_refused(bent: object) -> None:
    robot, spy = SafeRobot(spy := SpyRobot(), FLAT), spy
    with pytest.raises(InputError, match="base_T_tcp"):
        robot.move_linear(bent, speed=0.05)
    for q in (HOME * 1j, HOME.astype(str), HOME > 0, [*HOME[:6], None], "q", None, {}):
        with pytest.raises(InputError, match=r"^q: "):
            robot.move_joints(q, speed=0.05)
    assert spy.log == ["recover"]


def test_other_arguments_that_are_none_are_refused() -> None:
    robot = SafeRobot(spy := SpyRobot(), FLAT)
    for lines in (None, 3, [pose()], [(pose(), 0.05)], "abc"):
        with pytest.raises(InputError, match="lines"):
            robot.check_lines(lines)
    for confirmed in ("no", None, 1):
        with pytest.raises(InputError, match="confirmed"):
            robot.recover(confirmed=confirmed)
    for q in (None, "q", [[1.0], [2.0, 3.0]], HOME[:3]):
        with pytest.raises(InputError, match=r"^q: "):
            robot.stands_at(q)
        with pytest.raises(InputError, match=r"^q: "):
            SafeRobot(SpyRobot(), FLAT, home_q=q)
    with pytest.raises(InputError, match="grasp_m"):
        PickPlaceConfig(grasp_m="low")
    with pytest.raises(InputError, match="number"):
        PickPlaceAction((0.5, "0"), 0.0, (0.5, 0.1), 0.0)
    assert spy.log == ["recover"]


def test_what_is_checked_is_what_is_sent() -> None:
    """A caller that writes into its array after the check moves nothing by that."""
    spy = SpyRobot()
    target = pose(z=0.3)

    def meddling(arm: object, q: np.ndarray, T: np.ndarray, *, speed: float) -> object:
        from hardware.arm.straight_line import straight_line

        target[2, 3] = -0.5
        return straight_line(ARM, q, T, speed=speed)

    SafeRobot(spy, FLAT, line_solver=meddling).move_linear(target, speed=0.05)
    assert spy.lines[0][1][2, 3] == 0.3


# Limits that stay.


def test_limits_stay_as_the_robot_was_made_with_them() -> None:
    corner = np.array([0.335, 0.635])
    limits = SafetyLimits(table=TablePlane(0.0), x=corner)
    robot = SafeRobot(SpyRobot(), limits)
    corner[:] = -9.0, 9.0
    assert limits.x == (0.335, 0.635)
    for name in ("limits", "_limits", "_robot", "_checks", "_home", "_latch", "_lock", "_arm"):
        with pytest.raises(AttributeError):
            setattr(robot, name, None)
    with pytest.raises(AttributeError):
        robot._checks.limits = None
    with pytest.raises(ValueError, match="read-only"):
        DQ_MAX[0] = 99.0
    for wrong in (
        {"table": None},
        {"x": "ab"},
        {"x": 1.0},
        {"max_speed": "0.1"},
        {"max_recoveries": True},
    ):
        with pytest.raises(InputError, match="safety limit"):
            SafetyLimits(**{"table": TablePlane(0.0), **wrong})
    with pytest.raises(InputError, match="SafetyLimits"):
        SafeRobot(SpyRobot(), None)


# Stops that hold.


class Late(SpyRobot):
    """Somebody stops the arm between the check of a motion and its start."""

    robot: SafeRobot | None = None

    def state(self) -> Any:
        if self.robot is not None:
            robot, self.robot = self.robot, None
            thread = threading.Thread(target=robot.stop)
            thread.start()
            thread.join()
        return super().state()


@pytest.mark.parametrize("command", ["line", "joints", "home", "open", "grasp"])
def test_a_stop_between_check_and_motion_is_not_lost(command: str) -> None:
    spy = Late()
    robot = SafeRobot(spy, FLAT)
    calls: dict[str, Callable[[], object]] = {
        "line": lambda: robot.move_linear(pose(z=0.3), speed=0.05),
        "joints": lambda: robot.move_joints(HOME + 0.01, speed=0.05),
        "home": robot.home,
        "open": robot.open_gripper,
        "grasp": lambda: robot.grasp(width_m=0.01, force_N=5.0),
    }
    if command in ("open", "grasp"):
        robot.stop()
    else:
        spy.robot = robot
    for _ in range(2):
        with pytest.raises(MotionError, match="holds until recover"):
            calls[command]()
    assert "stop" in spy.log and not {"move_linear", "move_joints", "grasp"} & set(spy.log)
    robot.recover(confirmed=True)
    calls[command]()


@pytest.mark.parametrize("make", [lambda: SimRobot(TableWorld()), DryRunRobot])
def test_backends_hold_a_stop_until_recover(make: Callable[[], Any]) -> None:
    backend = make()
    backend.stop()
    for call in (
        lambda: backend.move_joints(HOME + 0.1, speed=0.1),
        lambda: backend.move_linear(pose(z=0.4), speed=0.1),
        backend.open_gripper,
        lambda: backend.grasp(width_m=0.01, force_N=5.0),
    ):
        with pytest.raises(MotionError, match="holds"):
            call()
    np.testing.assert_array_equal(backend.state().q, HOME)
    backend.recover()
    backend.move_joints(HOME + 0.1, speed=0.5)


def test_a_stop_ends_the_motion_of_another_thread_and_waits_for_no_lock() -> None:
    robot, world = watched(FAST)
    stopper = threading.Thread(target=robot.stop)
    world.at[50] = stopper.start
    with pytest.raises(MotionError, match="stopped"):
        robot.move_joints(HOME + 0.3 * np.eye(7)[6], speed=0.01)  # 1,150 steps left
    stopper.join()
    assert np.abs(world.robot.state().q - HOME).max() < 0.2


def test_a_recovery_clears_no_stop_that_comes_meanwhile() -> None:
    latch = StopLatch()
    latch.press()
    mark = latch.mark()
    latch.press()
    latch.release(mark)
    assert latch.pressed
    latch.release(latch.mark())
    latch.check()
    with pytest.raises(MotionError), latch.motion():
        latch.stop(lambda: None)
        latch.check()


def test_two_threads_command_one_after_the_other() -> None:
    """Checked from the same place and executed one after the other, two motions made a jump."""
    robot, world = watched(FAST)
    e = np.eye(7)[6]
    errors: list[RobotError] = []

    def other() -> None:
        try:
            robot.move_joints(HOME - 0.4 * e, speed=0.2)
        except RobotError as error:
            errors.append(error)

    second = threading.Thread(target=other)
    world.at[10] = second.start
    robot.move_joints(HOME + 0.4 * e, speed=0.2)
    second.join()
    assert len(errors) == 1 and "max_joint_step_rad: 0.80" in str(errors[0])
    np.testing.assert_allclose(world.robot.state().q, HOME + 0.4 * e)
