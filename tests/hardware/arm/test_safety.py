"""Every rule of `SafeRobot`, one by one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from fixtures.safety_spy import ARM, HOME, SpyRobot, assert_within, joints_at, pose

from hardware import (
    MotionError,
    ReflexError,
    RobotError,
    RobotMode,
    SafetyViolation,
    UserStopped,
)
from hardware.arm.limits import PATH_TOLERANCE, SafetyLimits, dense_path
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.straight_line import StraightLine
from hardware.arm.table_plane import TablePlane
from warp_deform.errors import InputError

FLAT = SafetyLimits(table=TablePlane(0.0))


def safe(limits: SafetyLimits = FLAT, **changes: object) -> tuple[SafeRobot, SpyRobot]:
    spy = SpyRobot(**changes)
    return SafeRobot(spy, limits), spy


def test_many_poses_at_once_are_the_poses() -> None:
    q = HOME + np.random.default_rng(0).uniform(-0.5, 0.5, (20, 7))
    np.testing.assert_allclose(ARM.poses(q), [ARM.pose(row) for row in q], atol=1e-14)


# The rules, one by one.


@pytest.mark.parametrize(
    ("target", "limit"),
    [
        (pose(x=0.3049), "workspace x, low side"),
        (pose(x=0.6651), "workspace x, high side"),
        (pose(y=-0.3301), "workspace y, low side"),
        (pose(y=0.3301), "workspace y, high side"),
        (pose(z=0.6001), "ceiling"),
        (pose(z=0.0089), r"floor \(table \+ min_tcp_height_m\)"),
        (pose(z=0.02, tilt=0.4), "hand above the table"),
        (pose(z=0.3, tilt=0.53), "tilt of the hand"),
    ],
)
def test_a_pose_beyond_a_limit_is_refused_by_name(target: np.ndarray, limit: str) -> None:
    robot, spy = safe()
    with pytest.raises(SafetyViolation, match=f"^{limit}: .* beyond it by 0"):
        robot.move_linear(target, speed=0.05, stop_force_N=8.0)
    with pytest.raises(SafetyViolation, match=limit):
        robot.check_lines([(target, 0.05, 8.0)])
    assert not spy.lines


def test_the_floor_follows_the_measured_plane() -> None:
    limits = SafetyLimits(table=TablePlane(-0.010, slope_x=0.02, slope_y=0.03))
    for y, floor in ((-0.25, -0.010 + 0.009 - 0.0075 + 0.009), (0.25, 0.0155)):
        robot, spy = safe(limits)
        robot.move_linear(pose(y=y, z=0.1), speed=0.05)
        with pytest.raises(SafetyViolation, match="floor"):
            robot.move_linear(pose(y=y, z=floor - 1e-4), speed=0.05, stop_force_N=8.0)
        robot.move_linear(pose(y=y, z=floor + 1e-4), speed=0.05, stop_force_N=8.0)
        assert_within(limits, spy)


def test_a_joint_path_is_checked_between_its_waypoints() -> None:
    """Both ends keep the side limit, and the arc between them does not."""
    limits = SafetyLimits(table=TablePlane(0.0), x=(0.28, 0.445), margin_m=0.0)
    ends = [joints_at(pose(0.44, y, 0.2)) for y in (-0.105, 0.105)]
    middle = ARM.pose(0.5 * (ends[0] + ends[1]))[0, 3]
    assert middle > 0.448
    robot, spy = safe(limits, q=ends[0])
    with pytest.raises(SafetyViolation, match="workspace x, high side: the path goes beyond"):
        robot.move_joints(ends[1], speed=0.05)
    assert not spy.joints


@pytest.mark.parametrize("points", [2, 5])
def test_a_dense_path_stays_near_its_chords(points: int) -> None:
    rng = np.random.default_rng(0)
    path = HOME + np.cumsum(rng.uniform(-0.2, 0.2, (points, 7)), axis=0)
    dense = dense_path(path)
    assert {tuple(q) for q in path} <= {tuple(q) for q in dense}
    middles = ARM.poses(0.5 * (dense[1:] + dense[:-1]))[:, :3, 3]
    tcp = ARM.poses(dense)[:, :3, 3]
    assert np.linalg.norm(middles - 0.5 * (tcp[1:] + tcp[:-1]), axis=1).max() < PATH_TOLERANCE


@pytest.mark.parametrize(
    ("call", "limit"),
    [
        (lambda r: r.move_joints(HOME + 0.01, speed=0.06), "max_joint_speed"),
        (lambda r: r.move_joints(HOME + 0.01, speed=float("nan")), "max_joint_speed"),
        (lambda r: r.move_linear(pose(z=0.3), speed=0.11), "max_speed"),
        (lambda r: r.move_linear(pose(z=0.3), speed=0.06), "max_descent_speed"),
        (lambda r: r.move_linear(pose(z=0.03), speed=0.05), "contact_height_m"),
        (
            lambda r: r.move_linear(pose(z=0.03), speed=0.05, stop_force_N=8.1),
            "max_contact_force_N",
        ),
        (lambda r: r.move_linear(pose(z=0.03), speed=0.05, stop_force_N=0.0), "max_contact_force"),
        (lambda r: r.grasp(width_m=0.01, force_N=60.0), "max_grasp_force_N"),
        (lambda r: r.move_joints(HOME + 0.51 * np.eye(7)[6], speed=0.05), "max_joint_step_rad"),
        (lambda r: r.move_joints(np.where(np.eye(7)[6], 2.7, HOME), speed=0.05), "joint_margin"),
        (
            lambda r: r.move_joints(np.linspace(HOME, joints_at(pose(z=0.045)), 9)[1:], speed=0.05),
            "contact_height_m",
        ),
    ],
)
def test_a_command_beyond_a_limit_is_refused_by_name(
    call: Callable[[SafeRobot], object], limit: str
) -> None:
    robot, spy = safe()
    with pytest.raises(SafetyViolation, match=f"^{limit}"):
        call(robot)
    assert spy.log == ["recover"]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.full((3, 7), np.nan), "inverse kinematics: its answer is not finite"),
        (np.zeros((0, 7)), "inverse kinematics: its answer has shape"),
        (np.zeros(7), "inverse kinematics: its answer has shape"),
        (HOME[None] + 0.01, "inverse kinematics: its answer ends"),
        (np.where(np.eye(7)[0], 2.8, HOME)[None], "joint_margin: joint 1 at 2.800"),
    ],
)
def test_a_wrong_answer_of_the_planner_is_refused(answer: np.ndarray, message: str) -> None:
    spy = SpyRobot()
    robot = SafeRobot(spy, FLAT, line_solver=lambda *_, **__: StraightLine(answer, 0.1))
    with pytest.raises(SafetyViolation, match=message):
        robot.move_linear(pose(z=0.3), speed=0.05)
    assert not spy.lines


def test_a_planner_that_jumps_or_strays_is_refused() -> None:
    end = joints_at(pose(0.5, 0.2, 0.3))
    for points, message in (
        (np.array([HOME, end]), "max_joint_step_rad"),
        (np.linspace(HOME, end, 6), "leaves the line by"),
    ):
        spy = SpyRobot()
        robot = SafeRobot(spy, FLAT, line_solver=lambda *_, p=points, **__: StraightLine(p, 0.1))
        with pytest.raises(SafetyViolation, match=message):
            robot.move_linear(ARM.pose(end), speed=0.05)


def test_arrival_is_measured_again() -> None:
    robot, spy = safe(miss=0.01)
    with pytest.raises(MotionError, match=r"ended \d+\.\d mm .* \(allowed: 3.0 mm"):
        robot.move_linear(pose(z=0.3), speed=0.05)
    spy.q = HOME.copy()
    with pytest.raises(MotionError, match="ended"):
        robot.move_joints(HOME + 0.05, speed=0.05)


def test_a_contact_is_no_missed_arrival() -> None:
    robot, _ = safe(contact_at=0.03)
    robot.move_linear(pose(z=0.07), speed=0.05)
    result = robot.move_linear(pose(z=0.01), speed=0.05, stop_force_N=8.0)
    assert result.contact and result.base_T_tcp[2, 3] == pytest.approx(0.03, abs=1e-4)


@pytest.mark.parametrize("force", [1.9, 2.1])
def test_a_hand_that_presses_softly_short_of_its_target_has_a_contact(force: float) -> None:
    """With 8 N as the stop force, from 2 N on; without one it is a failed motion."""
    robot, spy = safe()
    robot.move_linear(pose(z=0.07), speed=0.05)

    def held(base_T_tcp: np.ndarray, **_: object) -> None:
        spy.q = joints_at(pose(z=float(base_T_tcp[2, 3]) + 0.005))
        spy.force = np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
        raise MotionError("the TCP ended 5.0 mm from its target")

    spy.move_linear = held
    if force < 2.0:
        with pytest.raises(MotionError, match="ended 5"):
            robot.move_linear(pose(z=0.012), speed=0.05, stop_force_N=8.0)
    else:
        result = robot.move_linear(pose(z=0.012), speed=0.05, stop_force_N=8.0)
        assert result.contact and result.base_T_tcp[2, 3] == pytest.approx(0.017, abs=1e-4)
        with pytest.raises(MotionError, match="ended 5"):
            robot.move_linear(pose(z=0.0165), speed=0.05)


def test_an_arm_that_stands_outside_is_not_moved() -> None:
    outside = joints_at(pose(0.45, 0.30, 0.3))
    outside[0] += 0.15
    robot, spy = safe(q=outside)
    for call in (lambda: robot.move_linear(pose(), speed=0.05), robot.home):
        with pytest.raises(SafetyViolation, match=r"arm stands beyond it .* by hand"):
            call()
    assert spy.log == ["recover"]


def test_an_arm_a_little_outside_may_come_back_but_not_go_on() -> None:
    spy = SpyRobot(q=joints_at(pose(0.45, 0.0, 0.012)))
    limits = SafetyLimits(table=TablePlane(0.005))  # the floor is 2 mm above the TCP
    robot = SafeRobot(spy, limits)
    with pytest.raises(SafetyViolation, match="floor"):
        robot.move_linear(pose(0.5, 0.0, 0.0121), speed=0.05, stop_force_N=8.0)
    robot.move_linear(pose(0.45, 0.0, 0.07), speed=0.05)
    robot.home()
    assert_within(limits, spy)


def test_joint_waypoints_keep_the_height_that_a_start_may_miss() -> None:
    low = joints_at(pose(0.5, 0.0, 0.048))
    robot, _ = safe(q=low)
    with pytest.raises(SafetyViolation, match="contact_height_m"):
        robot.move_joints(joints_at(pose(0.5, 0.02, 0.0485)), speed=0.05)
    robot.move_joints(joints_at(pose(0.5, 0.02, 0.055)), speed=0.05)
    robot, _ = safe(q=joints_at(pose(0.5, 0.0, 0.04)))
    with pytest.raises(SafetyViolation, match="contact_height_m"):
        robot.move_joints(joints_at(pose(0.5, 0.02, 0.055)), speed=0.05)


def test_home_goes_up_first() -> None:
    robot, spy = safe(q=joints_at(pose(0.5, 0.1, 0.02)))
    robot.home()
    np.testing.assert_allclose(spy.q, HOME, atol=1e-9)
    assert spy.log == ["recover", "move_linear", "move_joints"]
    assert spy.lines[0][1][2, 3] == pytest.approx(0.051)
    assert_within(FLAT, spy)


def test_another_end_effector_is_found_out() -> None:
    robot, _ = safe(wrong_tcp=np.array([0.0, 0.0, 0.02]))
    with pytest.raises(SafetyViolation, match=r"end effector: .* 20.0 mm .* Desk"):
        robot.move_linear(pose(z=0.3), speed=0.05)


@pytest.mark.parametrize("q", [HOME * np.nan, np.where(np.eye(7)[3], np.nan, HOME)])
def test_a_reading_that_is_not_finite_is_refused(q: np.ndarray) -> None:
    robot, spy = safe()
    spy.q = q
    with pytest.raises(SafetyViolation, match="not finite"):
        robot.state()


@pytest.mark.parametrize(
    ("mode", "kind"),
    [
        (RobotMode.USER_STOPPED, UserStopped),
        (RobotMode.REFLEX, ReflexError),
        (RobotMode.GUIDING, MotionError),
        (RobotMode.MOVING, MotionError),
    ],
)
def test_only_an_idle_robot_is_moved(mode: RobotMode, kind: type[RobotError]) -> None:
    robot, spy = safe()
    spy.mode = mode
    for call in (lambda: robot.move_linear(pose(), speed=0.05), robot.home):
        with pytest.raises(kind):
            call()
    assert spy.log == ["recover"]


def test_recoveries_are_counted_per_episode_and_never_undo_a_user_stop() -> None:
    robot, spy = safe()
    for _ in range(2):
        robot.begin_episode()
        for _ in range(2):
            spy.mode = RobotMode.REFLEX
            robot.recover()
        with pytest.raises(SafetyViolation, match="max_recoveries"):
            robot.recover()
        spy.mode = RobotMode.REFLEX
        robot.recover(confirmed=True)  # an operator has looked: that counts for nothing
        assert spy.mode == RobotMode.IDLE
    robot.begin_episode()
    spy.mode = RobotMode.USER_STOPPED
    for confirmed in (False, True):
        with pytest.raises(UserStopped):
            robot.recover(confirmed=confirmed)
    assert spy.mode == RobotMode.USER_STOPPED


def test_ctrl_c_stops_the_arm() -> None:
    robot, spy = safe(interrupt=True)
    with pytest.raises(KeyboardInterrupt), robot:
        robot.move_linear(pose(z=0.3), speed=0.05)
    assert spy.log[-3:] == ["stop", "stop", "close"]
    robot, spy = safe()
    with robot:
        pass
    assert spy.log[-1:] == ["close"] and "stop" not in spy.log


@pytest.mark.parametrize(
    "change",
    [
        {"max_joint_speed": 0.21},
        {"max_descent_speed": 0.06},
        {"max_speed": 0.3},
        {"min_tcp_height_m": -0.001},
        {"max_z_m": float("nan")},
        {"x": (0.6, 0.3)},
        {"y": (0.0, float("inf"))},
        {"max_recoveries": -1},
    ],
)
def test_limits_that_are_none_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"safety limit {next(iter(change))} is"):
        SafetyLimits(table=TablePlane(0.0), **change)


def test_a_home_pose_outside_is_refused() -> None:
    with pytest.raises(InputError, match="home pose breaks the safety limits: workspace x"):
        SafeRobot(SpyRobot(), dataclasses.replace(FLAT, x=(0.4, 0.6)))
