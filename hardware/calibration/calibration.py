"""What links a robot, a camera and a table: one JSON file per setup."""

from __future__ import annotations

import datetime
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError

from ..arm.table_plane import TablePlane
from ..cameras.camera import CameraIntrinsics
from ..support.frozen import freeze_arrays
from ..support.json_file import read_json, read_numbers, require, write_json
from .homography import MAX_ERROR, apply_homography
from .workplace import Workplace

__all__ = ["SCHEMA", "Calibration"]

SCHEMA = 1
"""Version of the calibration file that this package writes and reads."""
_METHODS = ("charuco", "touched points", "hand-eye")


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """From pixels of pictures taken at the home pose to points on the table.

    Attributes:
        robot_id: which robot
        camera_id: which camera
        home_q: joint positions at which the pictures are taken [rad], shape (7,)
        intrinsics: of the camera
        base_H_pixel: from undistorted pixels (column, row, 1) to base x, y [m], shape (3, 3)
        table: the touched-off plane
        x: ends of the workspace along x [m]
        y: ends of the workspace along y [m]
        method: what gave the homography: "charuco", "touched points" or "hand-eye"
        error_m: error to expect, as the method measures it [m]
        details: further figures, JSON types: residuals, the board, tcp_T_camera
        created: when, ISO 8601
    """

    robot_id: str
    camera_id: str
    home_q: np.ndarray
    intrinsics: CameraIntrinsics
    base_H_pixel: np.ndarray
    table: TablePlane
    method: str
    error_m: float
    x: tuple[float, float] = Workplace.x
    y: tuple[float, float] = Workplace.y
    details: dict[str, Any] = field(default_factory=dict)
    created: str = field(
        default_factory=lambda: datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    )

    def __post_init__(self) -> None:
        if self.method not in _METHODS:
            raise InputError(f"calibration: method {self.method!r} is none of {_METHODS}")
        if not 0.0 <= self.error_m <= MAX_ERROR:
            raise InputError(
                f"calibration: its error is {self.error_m} m, {MAX_ERROR} m are allowed; "
                "calibrate anew"
            )
        H = np.asarray(self.base_H_pixel)
        if H.shape != (3, 3) or not np.isfinite(H).all() or np.linalg.cond(H) > 1e12:
            raise InputError("calibration: base_H_pixel is no invertible (3, 3) matrix")
        if np.asarray(self.home_q).shape != (7,) or not np.isfinite(self.home_q).all():
            raise InputError("calibration: home_q is not seven joint positions")
        self.workplace  # noqa: B018  refuses what the arm cannot do
        width, height = self.intrinsics.size
        frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
        depth = np.column_stack([frame, np.ones(4)]) @ H[2]
        if depth.min() * depth.max() <= 0.0:
            raise InputError("calibration: part of the picture looks past the table's horizon")
        freeze_arrays(self, "home_q", "base_H_pixel")

    @property
    def workplace(self) -> Workplace:
        """The home pose and the workspace."""
        home_q = tuple(float(value) for value in np.asarray(self.home_q))
        return Workplace(home_q=home_q, x=self.x, y=self.y)

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the camera's picture [px]."""
        return self.intrinsics.size

    def pixel_to_base(self, pixels: np.ndarray) -> np.ndarray:
        """Return the points on the table (n, 3) [m] seen at pixels (n, 2), column and row."""
        xy = apply_homography(self.base_H_pixel, self.intrinsics.undistort(pixels))
        return np.column_stack([xy, self.table.z(xy)])

    def base_to_pixel(self, xy: np.ndarray) -> np.ndarray:
        """Return the pixels (n, 2), column and row, where points x, y (n, 2) [m] are seen."""
        straight = apply_homography(np.linalg.inv(self.base_H_pixel), np.asarray(xy, dtype=float))
        return self.intrinsics.distort(straight)

    def to_record(self) -> dict[str, Any]:
        """Return the calibration as JSON types."""
        return {
            "schema": SCHEMA,
            "robot_id": self.robot_id,
            "camera_id": self.camera_id,
            "home_q": np.asarray(self.home_q, dtype=float).tolist(),
            "intrinsics": self.intrinsics.to_record(),
            "base_H_pixel": np.asarray(self.base_H_pixel, dtype=float).tolist(),
            "table": {
                "height_m": self.table.height_m,
                "slope_x": self.table.slope_x,
                "slope_y": self.table.slope_y,
            },
            "method": self.method,
            "error_m": self.error_m,
            "workspace": [*self.x, *self.y],
            "details": self.details,
            "created": self.created,
        }

    def digest(self) -> str:
        """Return a hash of the calibration, 32 hexadecimal digits."""
        text = json.dumps(self.to_record(), sort_keys=True, allow_nan=False)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all; InputError where it cannot be written."""
        write_json(path, self.to_record())

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Read a file.

        Raises:
            InputError: missing, damaged, of another version, or with values that cannot be
        """
        if not path.exists():
            raise InputError(
                f"calibration {path} is missing: make it with `franka calibrate`, or rehearse "
                "without one, with --robot sim --camera sim"
            )
        record = read_json(path, what="calibration", schema=SCHEMA)
        what = f"calibration {path}"
        try:
            table = require(record, "table", dict, what=what)
            # Files from before the workspace was a setting are of the one there was.
            ends = [*Workplace.x, *Workplace.y]
            if "workspace" in record:
                ends = read_numbers(record, "workspace", (4,), what=what).tolist()
            return cls(
                robot_id=require(record, "robot_id", str, what=what),
                camera_id=require(record, "camera_id", str, what=what),
                home_q=read_numbers(record, "home_q", (7,), what=what),
                intrinsics=CameraIntrinsics.from_record(record.get("intrinsics"), what=what),
                base_H_pixel=read_numbers(record, "base_H_pixel", (3, 3), what=what),
                table=TablePlane(
                    *(float(require(table, k, float, what=what)) for k in _PLANE_KEYS)
                ),
                method=require(record, "method", str, what=what),
                error_m=float(require(record, "error_m", float, what=what)),
                x=(ends[0], ends[1]),
                y=(ends[2], ends[3]),
                details=require(record, "details", dict, what=what),
                created=require(record, "created", str, what=what),
            )
        except InputError as error:
            message = str(error)
            raise InputError(
                message if message.startswith(what) else f"{path}: {message}"
            ) from error


_PLANE_KEYS = ("height_m", "slope_x", "slope_y")
