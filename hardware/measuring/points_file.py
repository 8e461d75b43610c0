"""Touched points in a text file: one a line, column and row [px], x and y [m].

    # calibrate points: robot panda 172.16.0.2, camera uvc, 1280 x 720 px
    # column [px], row [px], x [m], y [m]
    412.0, 230.5, 0.4000, -0.2000

Commas or blanks separate the numbers; "#" begins a comment. The first comment, where there is one,
says of what robot and camera the points are. A spreadsheet or an editor can make such a file.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

from warp_deform.errors import InputError

from ..calibration.workplace import Workplace
from ..cameras.camera import CameraIntrinsics
from ..rig.config import RigConfig
from ..rig.workplace import workplace_of
from ..support.json_file import write_whole

__all__ = ["TouchedPoint", "origin_line", "read_points", "write_points"]

_MARK = "# calibrate points: "
_COLUMNS = "# column [px], row [px], x [m], y [m]"
_MAX_BYTES = 2**20
_MAX_POINTS = 500


class TouchedPoint(NamedTuple):
    """A point of the table in the picture from home, and where it was touched."""

    column: float
    """[px]"""
    row: float
    """[px]"""
    x: float
    """In the base frame [m]."""
    y: float
    """In the base frame [m]."""


def origin_line(config: RigConfig, intrinsics: CameraIntrinsics) -> str:
    """Return the line that says of what robot, camera and size of picture points are."""
    width, height = intrinsics.size
    names = f"robot {config.robot_id}, camera {config.camera_id}"
    workplace = workplace_of(config)
    if not workplace.has_home_of(Workplace()):
        names += f", {workplace.home_text()}"
    return f"{_MARK}{names}, {width} x {height} px"


def write_points(path: Path, points: list[TouchedPoint], origin: str) -> None:
    """Write a file, whole or not at all; InputError where it cannot be written."""
    rows = [f"{p.column:.2f}, {p.row:.2f}, {p.x:.5f}, {p.y:.5f}" for p in points]
    write_whole(path, "\n".join([origin, _COLUMNS, *rows, ""]).encode())


def read_points(path: Path, origin: str) -> list[TouchedPoint]:
    """Return the points in a file.

    Args:
        path: the file
        origin: what its line of origin must be, if it has one; see `origin_line`

    Raises:
        InputError: it cannot be read, a line is no point, or they are of another setup
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"the points {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"the points {path} are no text; write a line for each point") from error
    points: list[TouchedPoint] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith(_MARK) and line.strip() != origin:
            theirs, ours = (each.removeprefix(_MARK).strip()[:160] for each in (line, origin))
            raise InputError(
                f"the points in {path} are of {theirs!r}, not of {ours!r}; give the same "
                "flags as then, or move that file away to begin anew"
            )
        words = re.split(r"\s*[,;\s]\s*", line.partition("#")[0].strip().rstrip(","))
        if words == [""]:
            continue
        try:
            point = TouchedPoint(*(float(word) for word in words))
        except (TypeError, ValueError):
            point = None
        if point is None or not all(math.isfinite(value) for value in point):
            raise InputError(
                f"line {number} of {path} is {line.strip()[:60]!r}; a point is four numbers: "
                "column and row [px], x and y [m]"
            )
        points.append(point)
    if len(data) > _MAX_BYTES or len(points) > _MAX_POINTS:
        raise InputError(f"{path} holds more than {_MAX_POINTS} points; it is another file")
    return points
