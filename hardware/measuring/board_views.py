"""Views of the board, of a lens or from a camera on the hand, kept in a file while they are taken.

A view is what was measured, the found corners and the hand's pose, not what follows from it: after
a mistake in the squares' size or in the lens the views are as good as before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warp_deform.errors import InputError

from ..calibration.charuco import BoardSpec, Corners
from ..cameras.camera import CameraIntrinsics
from ..rig.config import RigConfig
from ..support.json_file import read_json, read_numbers, require, write_json
from .measurement_file import MeasurementFile

__all__ = ["HandView", "hand_view_file", "lens_view_file"]

T = TypeVar("T")

_MIN_CORNERS = 4  # as many as tell a pose
_RIGID = 1e-3  # greatest departure of a stored rotation from an exact one


@dataclass(frozen=True, eq=False)
class HandView:
    """A view from a camera on the hand.

    Attributes:
        base_T_tcp: the hand's pose [m], shape (4, 4)
        corners: the board's corners in the picture
    """

    base_T_tcp: np.ndarray
    corners: Corners


def hand_view_file(
    config: RigConfig, board: BoardSpec, intrinsics: CameraIntrinsics
) -> MeasurementFile[HandView]:
    """Return the setup's kept views of `calibrate hand`, none yet or those of `views.json`.

    Raises:
        InputError: the file is damaged, or of another robot, camera, size of picture or board
    """
    return _measurement_file(
        config.setup / "views.json",
        {"robot_id": config.robot_id, **_origin(config, board, intrinsics.size)},
        write=lambda view: {"base_T_tcp": view.base_T_tcp.tolist(), **_record(view.corners)},
        read=lambda row, what: HandView(_pose(row, what), _corners(row, board, what)),
    )


def lens_view_file(
    config: RigConfig, board: BoardSpec, size: tuple[int, int]
) -> MeasurementFile[Corners]:
    """Return the setup's kept views of `calibrate lens`, none yet or those of `lens_views.json`.

    Raises:
        InputError: the file is damaged, or of another camera, size of picture or board
    """
    return _measurement_file(
        config.setup / "lens_views.json",
        _origin(config, board, size),
        write=_record,
        read=lambda row, what: _corners(row, board, what),
    )


def _measurement_file(
    path: Path,
    origin: dict[str, Any],
    *,
    write: Callable[[T], dict[str, Any]],
    read: Callable[[object, str], T],
) -> MeasurementFile[T]:
    """Views and their file, which holds what they are of beside them."""

    def write_all(path: Path, views: list[T]) -> None:
        write_json(path, {"schema": 1, **origin, "views": [write(view) for view in views]})

    def read_all(path: Path) -> list[T]:
        record = read_json(path, what="views", schema=1)
        for key, value in origin.items():
            if record.get(key) != value:
                raise InputError(
                    f"the views in {path} are of the {key} {str(record.get(key))[:60]}, not "
                    f"{value}; give the same flags as then, or remove that file to begin anew"
                )
        rows = require(record, "views", list, what=f"views {path}")
        return [read(row, f"view {n} of {path}") for n, row in enumerate(rows, start=1)]

    return MeasurementFile(path, "view", read=read_all, write=write_all)


def _origin(config: RigConfig, board: BoardSpec, size: tuple[int, int]) -> dict[str, Any]:
    return {
        "camera_id": config.camera_id,
        "size": list(size),
        "board": [board.columns, board.rows],
    }


def _record(corners: Corners) -> dict[str, Any]:
    return {"ids": corners.ids.tolist(), "pixels": corners.pixels.tolist()}


def _corners(row: object, board: BoardSpec, what: str) -> Corners:
    total = (board.columns - 1) * (board.rows - 1)
    ids = read_numbers(row, "ids", (-1,), what=what)
    pixels = read_numbers(row, "pixels", (-1, 2), what=what)
    known = np.isin(ids, np.arange(total)).all() and len(np.unique(ids)) == len(ids)
    if not known or len(ids) < _MIN_CORNERS or len(pixels) != len(ids):
        raise InputError(
            f"{what}: it needs {_MIN_CORNERS} or more different corners, 0 to {total - 1}, and a "
            "pixel of each; remove that file to begin anew"
        )
    return Corners(ids.astype(int), pixels)


def _pose(row: object, what: str) -> np.ndarray:
    hand = read_numbers(row, "base_T_tcp", (4, 4), what=what)
    R = hand[:3, :3]
    rigid = np.abs(R @ R.T - np.eye(3)).max() < _RIGID and np.linalg.det(R) > 0.0
    if not rigid or not np.array_equal(hand[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{what}: base_T_tcp is no pose; remove that file to begin anew")
    return hand
