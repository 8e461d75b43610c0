"""Views of the board from a camera on the hand, kept in a file while they are taken.

A view is what was measured, the hand's pose and the found corners, not what follows from it: after
a mistake in the squares' size or in the lens the views are as good as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_deform.errors import InputError

from .camera import CameraIntrinsics
from .charuco import BoardSpec, Corners
from .gathering import Kept
from .json_file import read_json, read_numbers, require, write_json
from .rig_config import RigConfig

__all__ = ["HandView", "kept_views"]

_MIN_CORNERS = 4  # as many as tell a pose
_RIGID = 1e-3  # greatest departure of a stored rotation from an exact one


@dataclass(frozen=True, eq=False)
class HandView:
    """A view.

    Attributes:
        base_T_tcp: the hand's pose [m], shape (4, 4)
        corners: the board's corners in the picture
    """

    base_T_tcp: np.ndarray
    corners: Corners


def kept_views(config: RigConfig, board: BoardSpec, intrinsics: CameraIntrinsics) -> Kept[HandView]:
    """Return the setup's kept views, none yet or those of `views.json`.

    Raises:
        InputError: the file is damaged, or of another robot, camera, size of picture or board
    """
    origin = {
        "robot_id": config.robot_id,
        "camera_id": config.camera_id,
        "size": list(intrinsics.size),
        "board": [board.columns, board.rows],
    }

    def write(path: Path, views: list[HandView]) -> None:
        rows = [
            {
                "base_T_tcp": view.base_T_tcp.tolist(),
                "ids": view.corners.ids.tolist(),
                "pixels": view.corners.pixels.tolist(),
            }
            for view in views
        ]
        write_json(path, {"schema": 1, **origin, "views": rows})

    def read(path: Path) -> list[HandView]:
        record = read_json(path, what="views", schema=1)
        for key, value in origin.items():
            if record.get(key) != value:
                raise InputError(
                    f"the views in {path} are of the {key} {str(record.get(key))[:60]}, not "
                    f"{value}; give the flags as then, or remove that file to begin anew"
                )
        rows = require(record, "views", list, what=f"views {path}")
        total = (board.columns - 1) * (board.rows - 1)
        return [_view(row, total, f"view {n} of {path}") for n, row in enumerate(rows, start=1)]

    return Kept(config.setup / "views.json", "view", read=read, write=write)


def _view(row: object, total: int, what: str) -> HandView:
    hand = read_numbers(row, "base_T_tcp", (4, 4), what=what)
    ids = read_numbers(row, "ids", (-1,), what=what)
    pixels = read_numbers(row, "pixels", (-1, 2), what=what)
    R = hand[:3, :3]
    rigid = np.abs(R @ R.T - np.eye(3)).max() < _RIGID and np.linalg.det(R) > 0.0
    if not rigid or not np.array_equal(hand[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{what}: base_T_tcp is no pose; remove that file to begin anew")
    known = np.isin(ids, np.arange(total)).all() and len(np.unique(ids)) == len(ids)
    if not known or len(ids) < _MIN_CORNERS or len(pixels) != len(ids):
        raise InputError(
            f"{what}: it needs {_MIN_CORNERS} or more different corners, 0 to {total - 1}, and a "
            "pixel of each; remove that file to begin anew"
        )
    return HandView(hand, Corners(ids.astype(int), pixels))
