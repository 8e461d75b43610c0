"""Finding the camera without a board: marks on the foam are shown in its picture and touched.

A mark is shown by a click or by typed pixels, and its place is where a person guides the closed
fingertips, or typed. What was measured is kept in `points.csv` of the setup until the calibration
is written. Points measured in another way come from a file of the same form.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warp_deform.errors import InputError

from ..arm.limits import FINGERTIP_BELOW_TCP, SafetyLimits
from ..arm.safe_robot import SafeRobot
from ..arm.table_plane import TablePlane
from ..calibration.homography import MIN_POINTS, HomographyFit, solve_homography
from ..cameras.camera import Camera, CameraIntrinsics
from ..choosers.human import TerminalOperator
from ..episodes.goals import write_picture
from ..rig.config import NETWORKED_ROBOTS, REAL_ROBOTS, RigConfig
from ..rig.rig import open_camera
from ..rig.workplace import workplace_of
from .measurement_file import MeasurementFile, gather
from .points_file import TouchedPoint, origin_line, read_points, write_points
from .steps import close_at_home, keep, lens_of, make_calibration, marked, open_arm, touched_table

__all__ = ["Show", "click_point", "measure_points", "points_from_file", "type_point"]

PicturePixel = tuple[float, float]
"""Column and row in the camera's picture [px]."""
Show = Callable[[np.ndarray, str, TerminalOperator], PicturePixel | None]
"""Returns column and row of a mark in a picture (H, W, 3), asked for by a text; None to stop."""

_BEYOND = 0.1  # how far beyond the workspace a point is believed [m]: more is another unit
_APART = 0.01  # [m]: nearer points are the same one twice, and would vouch for each other
_MIN_SHARE = 1 / 3  # of the workspace: outside of its points a homography is a guess
_TIP_HEIGHT = 0.01  # greatest distance of fingertips on a point from the table [m]


def measure_points(
    config: RigConfig,
    *,
    points: int = 9,
    show: Show | None = None,
    camera: Camera | None = None,
    robot: SafeRobot | None = None,
    operator: TerminalOperator | None = None,
) -> dict[str, Any]:
    """Find the table in the camera's picture from marks on it that are shown and touched; save.

    The arm goes home for the picture and closes its fingers. Then each mark is shown in the
    picture and a person guides the fingertips onto it. A result that is refused names the point
    to take again; points kept from a call that was stopped are gone on from.

    Args:
        config: robot, camera and setup
        points: how many, five or more
        show: how a mark is shown; default: `click_point`
        camera: default: the one that `config` names, opened and closed here
        robot: default: the one that `config` names, opened and closed here
        operator: the person at the robot; default: at this terminal

    Raises:
        InputError: too few points, stopped, or kept points that are not of this setup
        RobotError, CameraError: robot or camera fail
    """
    if points < MIN_POINTS:
        raise InputError(f"--points is {points}; {MIN_POINTS} are needed, 9 are better")
    if show is None:
        _pyplot()  # a missing display is said before the arm moves
    operator, show = operator or TerminalOperator(), show or click_point
    table = touched_table(config)
    lens = lens_of(config)
    with robot or open_arm(config, table) as arm:
        text = (
            f"lay {points} small flat marks onto the foam: near the workspace's corners, in the "
            "middle of its sides, in its middle; hold the hand 10 cm above them"
        )
        close_at_home(arm, operator, text)
        with camera or open_camera(config, lens) as device:
            frame = device.read()
        measured = _measurement_file(config, frame.intrinsics, arm.limits)
        marks_file = config.setup / "points_seen.png"

        def take(index: int) -> TouchedPoint:
            before, after = measured.items[:index], measured.items[index + 1 :]
            circles = np.array([point[:2] for point in [*before, *after]]).reshape(-1, 2)
            picture = marked(frame.rgb, circles)
            write_picture(marks_file, picture)
            name = f"point {index + 1} of {max(points, len(measured.items), index + 1)}"
            while True:
                pixel = show(picture, f"{name}, a mark without a circle in {marks_file}", operator)
                xy = None if pixel is None else _touched(arm, operator, name)
                if pixel is None or xy is None:
                    raise InputError("stopped before all points were taken")
                point = TouchedPoint(*pixel, *xy)
                try:
                    _check([*before, point, *after], frame.intrinsics, arm.limits)
                except InputError as error:
                    if not operator.go_on(error):
                        raise
                    continue
                return point

        def fit(taken: list[TouchedPoint]) -> HomographyFit:
            return _fit(taken, frame.intrinsics, arm.limits)

        with measured.guarded():
            homography = gather(measured, wanted=points, take=take, fit=fit, operator=operator)
            data = _save(config, measured.items, homography, frame.intrinsics, table)
        measured.remove()
    return data


def points_from_file(
    config: RigConfig, path: Path, *, camera: Camera | None = None
) -> dict[str, Any]:
    """Find the table in the camera's picture from a file of points, and save; nothing moves.

    The pixels are those of a picture from the home pose. Only a camera that tells its intrinsics
    itself is opened.

    Raises:
        InputError: no file of points, no robot named, or points that are refused
        PoorFit: they do not fit together to 3 mm rms
        CameraError: the camera fails
    """
    without_address = config.robot in NETWORKED_ROBOTS and config.host is None
    if config.robot not in REAL_ROBOTS or without_address:
        raise InputError(
            "whose are the points? give the --robot and --host that you will give to run"
        )
    table = touched_table(config)
    intrinsics = lens_of(config)
    if intrinsics is None:
        with camera or open_camera(config, None) as device:
            intrinsics = device.read().intrinsics
    points = read_points(path, origin_line(config, intrinsics))
    limits = workplace_of(config).limits(table)
    _check(points, intrinsics, limits)
    return _save(config, points, _fit(points, intrinsics, limits), intrinsics, table)


def _check(points: list[TouchedPoint], intrinsics: CameraIntrinsics, limits: SafetyLimits) -> None:
    """Refuse points that cannot be meant, each by itself and beside those before it.

    Raises:
        InputError: outside of the picture, far outside of the workspace, or the same one twice
    """
    width, height = intrinsics.size
    (x0, x1), (y0, y1) = limits.x, limits.y
    for number, point in enumerate(points, start=1):
        if not (-0.5 <= point.column <= width - 0.5 and -0.5 <= point.row <= height - 0.5):
            raise InputError(
                f"point {number}: column {point.column:g}, row {point.row:g} is outside of the "
                f"picture of {width} x {height}; give the column first"
            )
        if not (
            x0 - _BEYOND <= point.x <= x1 + _BEYOND and y0 - _BEYOND <= point.y <= y1 + _BEYOND
        ):
            raise InputError(
                f"point {number}: x {point.x:g} m, y {point.y:g} m is far from the workspace, x "
                f"{x0:g} to {x1:g}, y {y0:g} to {y1:g} m; check the unit, and touch it again"
            )
        for earlier, other in enumerate(points[: number - 1], start=1):
            if math.dist(point[2:], other[2:]) < _APART:
                raise InputError(
                    f"points {earlier} and {number} are nearer than {1e3 * _APART:g} mm to each "
                    "other; use another mark for one"
                )


def _fit(
    points: list[TouchedPoint], intrinsics: CameraIntrinsics, limits: SafetyLimits
) -> HomographyFit:
    """Return the homography of points if it is good enough; how far off each is goes to stderr.

    Raises:
        InputError: too few, near a line or mirrored, or not spread over the workspace
        PoorFit: they do not fit together to 3 mm rms
    """
    values = np.array(points, dtype=float).reshape(-1, 4)
    fit = solve_homography(values[:, :2], values[:, 2:], intrinsics)
    for number, (point, residual, left_out) in enumerate(
        zip(points, fit.residuals_m, fit.left_out_m, strict=True), start=1
    ):
        print(
            f"point {number}: pixel {point.column:.1f}, {point.row:.1f}; x {point.x:.4f}, y "
            f"{point.y:.4f} m; residual {1e3 * residual:.2f} mm, left out {1e3 * left_out:.2f} mm",
            file=sys.stderr,
            flush=True,
        )
    fit.check()
    (x0, x1), (y0, y1) = limits.x, limits.y
    within = np.clip(values[:, 2:], [x0, y0], [x1, y1]).astype(np.float32)
    share = cv2.contourArea(cv2.convexHull(within)) / ((x1 - x0) * (y1 - y0))
    if share < _MIN_SHARE:
        raise InputError(
            f"the points enclose {100 * share:.0f} % of the workspace, {100 * _MIN_SHARE:.0f} % "
            "are needed; touch points nearer its corners"
        )
    return fit


def click_point(picture: np.ndarray, text: str, operator: TerminalOperator) -> PicturePixel | None:
    """Return column and row of a click on a picture in a window; None where it is closed.

    Raises:
        InputError: there is no display
    """
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(13, 7.5), layout="tight")
    axes.imshow(picture)
    axes.set_title(f"click {text}; close to stop")
    clicks = plt.ginput(1, timeout=0)
    plt.close(figure)
    return (float(clicks[0][0]), float(clicks[0][1])) if clicks else None


def _pyplot() -> Any:
    """Return matplotlib's windows; InputError where there is no display."""
    import matplotlib

    if matplotlib.get_backend().lower() == "agg":
        raise InputError("there is no display to click on; give --typed")
    import matplotlib.pyplot as plt

    return plt


def type_point(picture: np.ndarray, text: str, operator: TerminalOperator) -> PicturePixel | None:
    """Return column and row as the operator types them, asked again until there are two numbers."""
    while True:
        reply = operator.answer(text, "its column and row [px]")
        if reply is None:
            return None
        if (numbers := _two_numbers(reply)) is not None:
            return numbers


def _touched(arm: SafeRobot, operator: TerminalOperator, name: str) -> tuple[float, float] | None:
    """Return x and y [m] of the fingertips on a point, or as typed; None to stop."""
    text = f"{name}: guide the closed fingertips onto it, down to the foam"
    while True:
        reply = operator.answer(text, "Enter: they are there, or type its x and y [mm]")
        if reply is None:
            return None
        if reply:
            if (typed := _two_numbers(reply)) is not None:
                return typed[0] / 1e3, typed[1] / 1e3
            continue
        T = arm.state().base_T_tcp
        # Along the hand's own axis: it leans when it is guided.
        tip = T[:3, 3] + FINGERTIP_BELOW_TCP * T[:3, 2]
        above = float(tip[2] - arm.limits.table.z(tip[:2]))
        if abs(above) <= _TIP_HEIGHT:
            return float(tip[0]), float(tip[1])
        side = "above" if above > 0.0 else "below"
        if not operator.wait(
            f"the fingertips are {1e3 * abs(above):.0f} mm {side} the touched-off table "
            f"(allowed: {1e3 * _TIP_HEIGHT:g} mm)"
        ):
            return None


def _two_numbers(text: str) -> tuple[float, float] | None:
    try:
        a, b = (float(word) for word in re.split(r"[,\s]+", text.strip()))
    except ValueError:
        return None
    return (a, b) if math.isfinite(a) and math.isfinite(b) else None


def _measurement_file(
    config: RigConfig, intrinsics: CameraIntrinsics, limits: SafetyLimits
) -> MeasurementFile[TouchedPoint]:
    origin = origin_line(config, intrinsics)

    def read(path: Path) -> list[TouchedPoint]:
        points = read_points(path, origin)
        try:
            _check(points, intrinsics, limits)
        except InputError as error:
            raise InputError(f"{path}: {error}; or remove that line") from error
        return points

    return MeasurementFile(
        config.setup / "points.csv",
        "point",
        read=read,
        write=lambda path, points: write_points(path, points, origin),
    )


def _save(
    config: RigConfig,
    points: list[TouchedPoint],
    fit: HomographyFit,
    intrinsics: CameraIntrinsics,
    table: TablePlane,
) -> dict[str, Any]:
    measured = {
        "points": [list(point) for point in points],
        "residuals_m": fit.residuals_m.tolist(),
        "left_out_m": fit.left_out_m.tolist(),
    }
    calibration = make_calibration(
        config,
        intrinsics,
        fit.base_H_pixel,
        table,
        method="touched points",
        error_m=fit.error_m,
        details={"report": fit.report(), **measured},
    )
    return {
        "calibration": keep(config, calibration),
        "report": fit.report(),
        "error_m": fit.error_m,
        **measured,
    }
