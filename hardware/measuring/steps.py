"""What the steps that measure a setup share: the arm, the lens, the questions, the file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warp_deform.errors import InputError

from ..arm.safe_robot import SafeRobot
from ..arm.table_plane import TablePlane
from ..calibration.calibration import Calibration
from ..calibration.picture_coverage import check_picture
from ..calibration.reach import check_workplace
from ..calibration.workplace import Workplace
from ..cameras.camera import CameraIntrinsics
from ..choosers.human import TerminalOperator
from ..episodes.operators import until_cleared
from ..rig.config import CAMERAS_WITHOUT_INTRINSICS, REAL_ROBOTS, RigConfig
from ..rig.rig import open_robot, read_intrinsics, read_table
from ..rig.workplace import workplace_of
from ..support.json_file import read_json, read_numbers
from .touch_off import close_fingers

__all__ = [
    "close_at_home",
    "confirm",
    "keep",
    "lens_of",
    "make_calibration",
    "marked",
    "open_arm",
    "touched_table",
]


def confirm(operator: TerminalOperator, text: str) -> None:
    """Wait until something is done by hand; InputError where the operator stops instead."""
    if not operator.wait(text):
        raise InputError("stopped; nothing was written")


def close_at_home(arm: SafeRobot, operator: TerminalOperator, text: str) -> None:
    """Send the arm home and close its fingers, as soon as the operator has made ready.

    Args:
        arm: moves
        operator: is asked first, and again until what stops the arm is cleared
        text: what is to be done before, for the operator

    Raises:
        InputError: the operator stops
        RobotError: see `until_cleared`
    """
    confirm(
        operator,
        f"{text}, nothing between the fingers; the arm then goes home and closes them",
    )
    until_cleared(arm, operator, arm.home)
    close_fingers(arm)


def open_arm(config: RigConfig, table: TablePlane) -> SafeRobot:
    """The arm that a calibration moves, kept above a table.

    Raises:
        InputError: it is none, or may not move, or cannot work there
    """
    if config.robot not in REAL_ROBOTS or not config.execute:
        raise InputError("this calibration moves an arm: give --robot panda and --execute")
    workplace = workplace_of(config)
    limits = workplace.limits(table, max_joint_speed=config.joint_speed)
    warning = check_workplace(workplace, limits)
    if warning is not None:
        print(warning, file=sys.stderr, flush=True)
    return SafeRobot(open_robot(config), limits, home_q=workplace.home_q)


def touched_table(config: RigConfig) -> TablePlane:
    """Return the plane that `calibrate table` wrote for this workspace.

    Raises:
        InputError: it is missing, damaged, or was touched off within another workspace: between its
            points a plane is measured, beyond them it is a guess, and the safety floor
    """
    path = config.setup / "table.json"
    table = read_table(path)
    record = read_json(path, what="table", schema=1)
    wanted, touched = workplace_of(config), Workplace()
    if "workspace" in record:
        x0, x1, y0, y1 = read_numbers(record, "workspace", (4,), what=f"table {path}").tolist()
        touched = Workplace(x=(x0, x1), y=(y0, y1))
    if not touched.has_workspace_of(wanted):
        raise InputError(
            f"{path} was touched off within {touched.workspace_text()}, not "
            f"{wanted.workspace_text()}; calibrate table with that workspace first"
        )
    return table


def keep(config: RigConfig, calibration: Calibration) -> Path:
    """Write the setup's calibration, and its home pose and workspace; returns its file."""
    calibration.workplace.save(config.setup)
    path = config.setup / "calibration.json"
    calibration.save(path)
    return path


def lens_of(config: RigConfig) -> CameraIntrinsics | None:
    """Return the measured intrinsics of a camera that does not tell its own; None for others."""
    if config.camera not in CAMERAS_WITHOUT_INTRINSICS:
        return None
    return read_intrinsics(config.setup / "lens.json")


def make_calibration(
    config: RigConfig,
    intrinsics: CameraIntrinsics,
    base_H_pixel: np.ndarray,
    table: TablePlane,
    *,
    method: str,
    error_m: float,
    details: dict[str, Any],
) -> Calibration:
    """Return the setup's calibration, of pictures from the home pose; see `Calibration`.

    Raises:
        InputError: the pictures do not show all of the workspace; it says what would cure that
    """
    workplace = workplace_of(config)
    calibration = Calibration(
        robot_id=config.robot_id,
        camera_id=config.camera_id,
        home_q=np.array(workplace.home_q),
        intrinsics=intrinsics,
        base_H_pixel=base_H_pixel,
        table=table,
        method=method,
        error_m=error_m,
        x=workplace.x,
        y=workplace.y,
        details=details,
    )
    check_picture(calibration, workplace.limits(table))
    return calibration


def marked(rgb: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return a copy of a picture (H, W, 3) uint8 with circles at pixels (n, 2), column and row."""
    picture = rgb.copy()
    for column, row in np.rint(pixels).astype(int):
        cv2.circle(picture, (int(column), int(row)), 5, (255, 0, 0), 1)
    return picture
