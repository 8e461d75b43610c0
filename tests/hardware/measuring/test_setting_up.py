"""Measuring a setup: what is asked, what moves, and what is written."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from fixtures.board_photographs import BOARD, INTRINSICS, TABLE, photograph
from fixtures.guided_robot import BASE_T_BOARD, TCP_T_CAMERA, GuidedRobot, Homing, setup
from fixtures.safety_spy import ARM, HOME, SpyRobot, joints_at, pose, solved_line
from fixtures.touched_table import TouchedTable

from hardware import GraspError, RobotMode
from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.calibration.calibration import Calibration
from hardware.calibration.homography import plane_homography
from hardware.cameras.camera import Frame
from hardware.choosers.human import TerminalOperator
from hardware.measuring.with_board import (
    measure_camera,
    measure_hand_eye,
    measure_lens,
    measure_table,
)
from hardware.rig.config import RigConfig
from hardware.rig.rig import read_table
from warp_deform.errors import InputError

VIEWS = 10


class HandCamera:
    """Sees the board from the arm's hand."""

    def __init__(self, robot: SpyRobot, rng: np.random.Generator) -> None:
        self.robot, self.rng = robot, rng

    def read(self) -> Frame:
        camera = self.robot.state().base_T_tcp @ TCP_T_CAMERA
        rgb = photograph(self.rng, np.linalg.inv(camera) @ BASE_T_BOARD)
        return Frame(rgb, None, INTRINSICS, 0.0)

    def close(self) -> None:
        pass

    def __enter__(self) -> HandCamera:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_a_camera_on_the_hand_is_found_by_someone_who_forgets_the_user_stop(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    robot = GuidedRobot()
    said: list[str] = []

    def guide(text: str) -> str:
        said.append(text)
        if "user stop" not in text:
            robot.guide(rng)
        else:
            robot.q = HOME + 0.02  # from where the arm may go home
        pressed = len(said) < 2 or "release the user stop" not in said[-2]
        robot.mode = RobotMode.USER_STOPPED if pressed else RobotMode.IDLE
        return ""

    found = measure_hand_eye(
        setup(tmp_path),
        BOARD,
        views=VIEWS,
        camera=HandCamera(robot, rng),
        robot=SafeRobot(robot, SafetyLimits(table=TABLE)),
        operator=TerminalOperator(guide),
    )
    assert len(said) >= VIEWS + 2 and robot.log.count("move_joints") == 1
    assert "release the user stop; the arm then goes home" in said[-2]
    assert "the user stop is pressed" in said[-1]
    calibration = Calibration.load(tmp_path / "calibration.json")
    assert calibration.method == "hand-eye" and found["error_m"] < 1e-3
    H = plane_homography(INTRINSICS, ARM.pose(HOME) @ TCP_T_CAMERA, TABLE)
    pixels = np.array([[300.0, 200.0], [900.0, 200.0], [900.0, 500.0], [300.0, 500.0], [640, 360]])
    at = [np.column_stack([pixels, np.ones(5)]) @ each.T for each in (calibration.base_H_pixel, H)]
    mine, true = (each[:, :2] / each[:, 2:] for each in at)
    assert np.linalg.norm(mine - true, axis=1).max() < 1.5e-3


def test_too_few_views_are_refused_before_the_first(tmp_path: Path) -> None:
    def never(text: str) -> str:
        raise AssertionError(text)

    for measure in (measure_hand_eye, measure_lens):
        with pytest.raises(InputError, match="--views is 7; 8 are needed"):
            measure(RigConfig(setup=tmp_path), BOARD, views=7, operator=TerminalOperator(never))


class TouchingRobot(SpyRobot):
    """An arm whose closed fingertips a person guides onto the board's corners."""

    def __init__(self, *, object_width: float) -> None:
        super().__init__(object_width=object_width)
        self.asked: list[str] = []

    def answer(self, text: str) -> str:
        self.asked.append(text)
        if "corner" in text:
            assert self.width < 1e-3 and self.log == ["recover", "move_joints", "grasp"]
            corner = BOARD.corners_m[int(text.split("corner ")[1].split()[0])]
            x, y, _ = BASE_T_BOARD[:3, :3] @ corner + BASE_T_BOARD[:3, 3]
            self.q = joints_at(pose(x, y, 0.35))
        return ""


def test_the_board_s_corners_are_touched_with_closed_fingers(tmp_path: Path) -> None:
    config = setup(tmp_path)
    for width in (0.01, 0.0):
        robot = TouchingRobot(object_width=width)
        camera = HandCamera(robot, np.random.default_rng(0))
        measure = functools.partial(
            measure_camera,
            config,
            BOARD,
            corner_ids=(0, 5, 18, 23),
            camera=camera,
            robot=SafeRobot(robot, SafetyLimits(table=TABLE)),
            operator=TerminalOperator(robot.answer),
        )
        if width:
            with pytest.raises(GraspError, match="not closed; take out"):
                measure()
            assert len(robot.asked) == 1 and not (tmp_path / "calibration.json").exists()
        else:
            assert measure()["error_m"] < 1.5e-3 and len(robot.asked) == 5
    assert Calibration.load(tmp_path / "calibration.json").method == "charuco"


def test_stopping_writes_nothing(tmp_path: Path) -> None:
    robot = GuidedRobot()
    config = setup(tmp_path)
    safe = SafeRobot(robot, SafetyLimits(table=TABLE))
    camera = HandCamera(robot, np.random.default_rng(0))
    with pytest.raises(InputError, match="nothing was written"):
        measure_hand_eye(
            config, BOARD, camera=camera, robot=safe, operator=TerminalOperator(lambda _: "q")
        )
    with pytest.raises(InputError, match="--execute"):
        measure_hand_eye(config, BOARD)
    assert [path.name for path in tmp_path.iterdir()] == ["table.json"]
    assert not robot.joints and not robot.lines


@pytest.mark.parametrize("kind", [Homing, TouchedTable])
def test_the_table_is_asked_for_then_touched_with_homed_fingers(
    tmp_path: Path, kind: type[TouchedTable]
) -> None:
    spy = kind(object_width=0.0)
    asked: list[tuple[str, int]] = []

    def answer(text: str) -> str:
        asked.append((text, len(spy.log)))
        return ""

    found = measure_table(
        RigConfig(setup=tmp_path, robot="fr3"),
        provisional_z=-0.015,
        robot=SafeRobot(spy, SafetyLimits(table=TablePlane(-0.015)), line_solver=solved_line),
        operator=TerminalOperator(answer),
    )
    table = read_table(tmp_path / "table.json")
    assert table.z(np.array([0.5, 0.1])) == pytest.approx(
        spy.true.z(np.array([0.5, 0.1])), abs=1e-4
    )
    assert "calibrate camera, points or hand" in found["next"]
    assert "five points" in asked[0][0] and asked[0][1] == 1  # recovered, nothing else
    if kind is Homing:
        assert spy.log[:4] == ["recover", "move_joints", "home_gripper", "grasp"]
        assert len(asked) == 1
    else:
        assert spy.log[:3] == ["recover", "move_joints", "grasp"]
        assert "Desk" in asked[1][0] and asked[1][1] == 2 and len(asked) == 2
    assert spy.log[-3:] == ["move_joints", "open_gripper", "close"]


def test_a_table_that_is_not_confirmed_moves_nothing(tmp_path: Path) -> None:
    spy = Homing(object_width=0.0)
    safe = SafeRobot(spy, SafetyLimits(table=TablePlane(-0.015)))
    with pytest.raises(InputError, match="nothing was written"):
        measure_table(
            RigConfig(setup=tmp_path),
            provisional_z=-0.015,
            robot=safe,
            operator=TerminalOperator(lambda _: "q"),
        )
    assert spy.log == ["recover", "stop", "close"] and not list(tmp_path.iterdir())
