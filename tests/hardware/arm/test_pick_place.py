"""The pick-and-place primitive: its waypoints, its outcomes, and that it keeps the limits."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.board_photographs import INTRINSICS, camera_above
from fixtures.safety_spy import ARM, HOME, SpyRobot, assert_within, solved_line
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import MoveResult, RobotError, SafetyViolation
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q
from hardware.arm.pick_place import (
    PickPlaceAction,
    PickPlaceConfig,
    PickPlaceOutcome,
    execute,
    waypoints,
)
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.backends.dry_run import DryRunRobot
from hardware.calibration.calibration import Calibration
from hardware.calibration.homography import plane_homography
from warp_deform.errors import InputError

TABLE = TablePlane(0.012, slope_x=0.01, slope_y=-0.02)
LIMITS = SafetyLimits(table=TABLE)
ACTION = PickPlaceAction((0.42, -0.12), 0.4, (0.55, 0.10), 0.9)


def height(T: np.ndarray) -> float:
    return float(T[2, 3] - TABLE.z(T[:2, 3]))


class LosingRobot(SpyRobot):
    """Loses what it holds once it is lifted."""

    def move_linear(self, base_T_tcp: np.ndarray, **options: object) -> MoveResult:
        result = super().move_linear(base_T_tcp, **options)
        if "grasp" in self.log and self.width < 0.01:
            self.width = 0.0
        return result


def test_waypoints_point_down_along_the_tangents() -> None:
    config = PickPlaceConfig()
    poses = waypoints(ACTION, TABLE)
    heights = {name: height(T) for name, T in poses.items()}
    assert list(poses) == ["hover", "grasp", "lift", "carry", "place", "retreat"]
    assert heights == pytest.approx(
        {"hover": config.hover_m, "grasp": config.grasp_m, "lift": config.lift_m,
         "carry": config.lift_m, "place": config.place_m, "retreat": config.hover_m}
    )  # fmt: skip
    for name, T in poses.items():
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-12)
        picking = name in {"hover", "grasp", "lift"}
        xy, yaw = (
            (ACTION.pick_xy, ACTION.pick_yaw) if picking else (ACTION.place_xy, ACTION.place_yaw)
        )
        np.testing.assert_allclose(T[:2, 3], xy)
        # The hand's x axis lies along the tangent, either way round; the fingers open across it.
        assert abs(T[0, 0] * np.cos(yaw) + T[1, 0] * np.sin(yaw)) == pytest.approx(1.0)
        assert abs(T[0, 1] * np.cos(yaw) + T[1, 1] * np.sin(yaw)) < 1e-12


@settings(derandomize=True, deadline=None, max_examples=300)
@given(
    pick=st.floats(-10, 10),
    turn=st.floats(-1.55, 1.55),
    x=st.floats(0.35, 0.6),
    y=st.floats(-0.3, 0.3),
)
def test_the_hand_turns_the_cable_as_asked(pick: float, turn: float, x: float, y: float) -> None:
    poses = waypoints(PickPlaceAction((x, y), pick, (0.5, 0.0), pick + turn), TABLE)
    a, b = poses["lift"][:3, :3], poses["carry"][:3, :3]
    relative = b @ a.T
    assert np.arctan2(relative[1, 0], relative[0, 0]) == pytest.approx(turn, abs=1e-9)


def test_a_short_move_is_lifted_less() -> None:
    near = PickPlaceAction((0.45, 0.0), 0.0, (0.45, 0.06), 0.0)
    assert height(waypoints(near, TABLE)["carry"]) == pytest.approx(PickPlaceConfig().short_lift_m)


def test_placing() -> None:
    spy = SpyRobot()
    robot = SafeRobot(spy, LIMITS)
    result = execute(robot, ACTION)
    assert result.outcome == PickPlaceOutcome.PLACED
    assert (result.width_after_grasp_m, result.width_after_lift_m) == (0.004, 0.004)
    assert height(result.base_T_pick) == pytest.approx(0.010, abs=1e-4)
    assert result.base_T_place is not None
    np.testing.assert_allclose(result.base_T_place[:2, 3], ACTION.place_xy, atol=1e-4)
    assert [entry for entry in spy.log if entry in {"open_gripper", "grasp"}] == [
        "open_gripper",
        "grasp",
        "open_gripper",
    ]
    np.testing.assert_allclose(spy.q, HOME, atol=1e-9)
    assert_within(LIMITS, spy)


@pytest.mark.parametrize(
    ("spy", "after_lift"), [(SpyRobot(object_width=0.0), None), (LosingRobot(), 0.0)]
)
def test_a_missed_or_lost_cable_is_an_outcome(spy: SpyRobot, after_lift: float | None) -> None:
    result = execute(SafeRobot(spy, LIMITS), ACTION)
    assert result.outcome == PickPlaceOutcome.MISSED_GRASP
    assert result.width_after_lift_m == after_lift
    assert result.base_T_place is None
    assert spy.width == 0.035 and spy.log[-1] == "move_joints"
    np.testing.assert_allclose(spy.q, HOME, atol=1e-9)
    assert_within(LIMITS, spy)


def test_a_contact_near_the_table_is_an_arrival() -> None:
    level = SafetyLimits(table=TablePlane(0.0))
    spy = SpyRobot(contact_at=0.014)
    result = execute(SafeRobot(spy, level), ACTION)
    assert result.outcome == PickPlaceOutcome.PLACED
    assert result.base_T_pick[2, 3] == pytest.approx(0.014, abs=1e-4)
    # Before the fingers closed the hand rose a little.
    grasp = spy.log.index("grasp")
    number = spy.log[:grasp].count("move_linear") - 1
    assert spy.lines[number][1][2, 3] == pytest.approx(0.016, abs=1e-4)
    assert_within(level, spy)


def test_a_contact_high_up_is_an_obstacle() -> None:
    level = SafetyLimits(table=TablePlane(0.0))
    spy = SpyRobot(contact_at=0.04)
    result = execute(SafeRobot(spy, level), ACTION)
    assert result.outcome == PickPlaceOutcome.OBSTRUCTED
    assert "grasp" not in spy.log and spy.log[-1] == "move_joints"
    assert_within(level, spy)


def test_nothing_moves_when_any_waypoint_is_refused() -> None:
    for action in (
        PickPlaceAction((0.42, -0.12), 0.0, (0.55, 0.34), 0.0),
        PickPlaceAction((0.72, -0.12), 0.0, (0.55, 0.30), 0.0),
    ):
        spy = SpyRobot()
        with pytest.raises(SafetyViolation, match="workspace"):
            execute(SafeRobot(spy, LIMITS), action)
        assert spy.log == ["recover"]


def test_a_turn_that_the_last_joint_cannot_make_is_refused() -> None:
    half_turn = PickPlaceAction((0.42, 0.0), 0.1, (0.42, 0.1), 0.1 + np.pi)
    waypoints(half_turn, TABLE)
    with pytest.raises(InputError, match="finite"):
        PickPlaceAction((0.42, np.nan), 0.1, (0.42, 0.1), 0.1)


@pytest.mark.parametrize(
    "change",
    [
        {"hover_m": 0.005},
        {"lift_m": 0.01},
        {"grasp_width_m": 0.05},
        {"speed": float("nan")},
        {"stop_force_N": -1.0},
    ],
)
def test_a_wrong_configuration(change: dict) -> None:
    with pytest.raises(InputError, match="pick_place"):
        PickPlaceConfig(**change)


def test_the_dry_run_does_it_all() -> None:
    robot = DryRunRobot()
    result = execute(SafeRobot(robot, LIMITS), ACTION)
    assert result.outcome == PickPlaceOutcome.PLACED
    names = [command.name for command in robot.commands]
    assert names.count("move_linear") == 6 and names[-1] == "move_joints"


# Whatever the policy, the calibration and the table say.

central = st.tuples(st.floats(450, 850), st.floats(200, 500))
pixels = central | central | st.tuples(st.floats(-200, 1500), st.floats(-200, 900))
tables = st.builds(
    TablePlane, st.floats(-0.05, 0.1), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)
)
yaws = st.floats(-7.0, 7.0)


@settings(derandomize=True, deadline=None, max_examples=100)
@given(
    pick=pixels,
    place=pixels,
    pick_yaw=yaws,
    place_yaw=yaws,
    table=tables,
    height=st.floats(0.3, 1.5),
    tilt=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    object_width=st.sampled_from([0.0, 0.004, 0.03]),
    contact=st.sampled_from([None, 0.01, 0.05]),
)
def test_no_action_and_no_calibration_gets_past_the_limits(
    pick: tuple,
    place: tuple,
    pick_yaw: float,
    place_yaw: float,
    table: TablePlane,
    height: float,
    tilt: tuple,
    object_width: float,
    contact: float | None,
) -> None:
    limits = SafetyLimits(table=table)
    spy = SpyRobot(object_width=object_width)
    spy.contact_at = None if contact is None else table.height_m + contact
    try:
        calibration = Calibration(
            robot_id="r",
            camera_id="c",
            home_q=np.array(HOME_Q),
            intrinsics=INTRINSICS,
            base_H_pixel=plane_homography(INTRINSICS, camera_above(tilt, height), table),
            table=table,
            method="hand-eye",
            error_m=0.001,
        )
        xy = calibration.pixel_to_base(np.array([pick, place]))[:, :2].tolist()
        action = PickPlaceAction(tuple(xy[0]), pick_yaw, tuple(xy[1]), place_yaw)
        execute(SafeRobot(spy, limits, line_solver=solved_line), action)
    except (RobotError, InputError) as refused:
        assert "\n" not in str(refused)
    assert_within(limits, spy)
    assert ARM.pose(spy.q)[2, 3] > table.z(ARM.pose(spy.q)[:2, 3])


@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    pick=st.tuples(st.floats(0.36, 0.63), st.floats(-0.3, 0.3)),
    place=st.tuples(st.floats(0.36, 0.63), st.floats(-0.3, 0.3)),
    pick_yaw=st.floats(-1.5, 1.5),
    turn=st.floats(-0.7, 0.7),
)
def test_the_whole_workspace_is_within_reach(
    pick: tuple, place: tuple, pick_yaw: float, turn: float
) -> None:
    action = PickPlaceAction(pick, pick_yaw, place, pick_yaw + turn)
    robot = SafeRobot(SpyRobot(), SafetyLimits(table=TablePlane(0.0)))
    down = {"hover", "grasp", "place"}
    robot.check_lines(
        [
            (T, 0.05, 8.0 if name in down else None)
            for name, T in waypoints(action, TablePlane(0.0)).items()
        ]
    )
