"""What the steps that measure a setup share: the arm, the lens, the questions, the file."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from warp_deform.errors import InputError

from .calibration import Calibration
from .camera import CameraIntrinsics
from .human import Terminal
from .panda_arm import HOME_Q
from .rig import open_robot, read_intrinsics
from .rig_config import REAL_ROBOTS, RigConfig
from .safety import SafeRobot
from .safety_limits import SafetyLimits
from .table_plane import TablePlane

__all__ = ["confirm", "lens_of", "make_calibration", "marked", "open_arm"]


def confirm(operator: Terminal, text: str) -> None:
    """Wait until something is done by hand; InputError where the operator stops instead."""
    if not operator.wait(text):
        raise InputError("stopped; nothing was written")


def open_arm(config: RigConfig, table: TablePlane) -> SafeRobot:
    """The arm that a calibration moves, kept above a table.

    Raises:
        InputError: it is none, or may not move
    """
    if config.robot not in REAL_ROBOTS or not config.execute:
        raise InputError("this calibration moves an arm: give --robot panda and --execute")
    limits = SafetyLimits(table=table, max_joint_speed=config.joint_speed)
    return SafeRobot(open_robot(config), limits)


def lens_of(config: RigConfig) -> CameraIntrinsics | None:
    """Intrinsics of a video device; other cameras tell their own."""
    return read_intrinsics(config.setup / "lens.json") if config.camera == "uvc" else None


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
    """Return the setup's calibration, of pictures from the home pose; see `Calibration`."""
    return Calibration(
        robot_id=config.robot_id,
        camera_id=config.camera_id,
        home_q=np.array(HOME_Q),
        intrinsics=intrinsics,
        base_H_pixel=base_H_pixel,
        table=table,
        method=method,
        error_m=error_m,
        details=details,
    )


def marked(rgb: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return a copy of a picture (H, W, 3) uint8 with circles at pixels (n, 2), column and row."""
    picture = rgb.copy()
    for column, row in np.rint(pixels).astype(int):
        cv2.circle(picture, (int(column), int(row)), 5, (255, 0, 0), 1)
    return picture
