"""Measuring a setup step by step, with a person at the robot; each step writes one file.

    board -> lens.json -> table.json -> calibration.json -> empty_view.png

The camera is found by touching corners of a board that it sees from home (`measure_camera`), or by
looking at a board that nobody touches from many sides (`measure_hand_eye`); without a board see
`hardware.measuring.with_points`.

The lens is measured for video devices alone: RealSense and Azure Kinect tell their intrinsics.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError

from ..arm.safe_robot import SafeRobot
from ..arm.table_plane import TablePlane, fit_table_plane
from ..calibration.charuco import (
    MIN_VIEWS,
    BoardSpec,
    Corners,
    board_pose,
    calibrate_intrinsics,
    find_corners,
)
from ..calibration.hand_eye import MIN_POSES, HandEye, calibrate_hand_eye
from ..calibration.homography import board_on_table, fit_homography, plane_homography
from ..calibration.poor_fit import PoorFit
from ..cameras.camera import Camera, CameraIntrinsics
from ..choosers.human import TerminalOperator
from ..episodes.goals import write_picture
from ..episodes.operators import until_cleared
from ..rig.config import RigConfig
from ..rig.rig import open_camera, read_calibration
from ..rig.workplace import workplace_of
from ..support.json_file import write_json
from .board_views import HandView, hand_view_file, lens_view_file
from .measurement_file import gather
from .steps import (
    close_at_home,
    confirm,
    keep,
    lens_of,
    make_calibration,
    marked,
    open_arm,
    touched_table,
)
from .touch_off import touch_off

__all__ = [
    "measure_camera",
    "measure_hand_eye",
    "measure_lens",
    "measure_table",
    "photograph_empty",
    "print_board",
]

_PIXELS_PER_METRE = 10_000.0  # 254 dots an inch
_INSET = 0.05  # [m] from the workspace's rim, where the foam lies flat


def print_board(setup: Path, board: BoardSpec) -> dict[str, Any]:
    """Write the board's picture; print it at 254 dots an inch and measure the squares."""
    picture = board.picture(_PIXELS_PER_METRE)
    path = setup / "board.png"
    write_picture(path, np.repeat(picture[..., None], 3, axis=2))
    size = f"{1e3 * board.square_m:g} mm squares, {board.columns} x {board.rows}"
    return {"board": path, "size": size, "dots_an_inch": 254}


def measure_lens(
    config: RigConfig,
    board: BoardSpec,
    *,
    views: int = 15,
    size: tuple[int, int] = (1280, 720),
    camera: Camera | None = None,
    operator: TerminalOperator | None = None,
) -> dict[str, Any]:
    """Measure a video device's intrinsics from views of the board, one an Enter.

    Views are kept in `lens_views.json` until the intrinsics are written: the next call goes on from
    them, and where they do not fit together the worst is taken again.

    Raises:
        InputError: too few views, stopped, or kept ones that are not of this setup
        CameraError: the device cannot be opened
    """
    _check_views(views, MIN_VIEWS)
    operator = operator or TerminalOperator()
    rough = CameraIntrinsics(
        size,
        np.array([[size[0], 0.0, size[0] / 2], [0.0, size[0], size[1] / 2], [0.0, 0.0, 1.0]]),
        np.zeros(0),
    )
    measured = lens_view_file(config, board, size)
    path = config.setup / "lens.json"
    with camera or open_camera(config, rough) as device:

        def take(index: int) -> Corners:
            name = f"view {index + 1} of {max(views, len(measured.items), index + 1)}"
            while operator.wait(f"{name}: hold the board still, tilted, elsewhere"):
                try:
                    return find_corners(device.read().rgb, board)
                except InputError as error:
                    operator.wait(str(error))
            raise InputError("stopped before all views were taken")

        def fit(taken: list[Corners]) -> tuple[CameraIntrinsics, float]:
            return calibrate_intrinsics(taken, board, size)

        with measured.guarded():
            intrinsics, rms = gather(measured, wanted=views, take=take, fit=fit, operator=operator)
            write_json(path, {"schema": 1, **intrinsics.to_record(), "error_px": rms})
    measured.remove()
    return {"lens": path, "error_px": rms}


def measure_table(
    config: RigConfig,
    *,
    provisional_z: float | None,
    touch: Callable[..., np.ndarray] = touch_off,
    robot: SafeRobot | None = None,
    operator: TerminalOperator | None = None,
) -> dict[str, Any]:
    """Home the fingers, touch the foam at the workspace's corners and fit a plane; the arm moves.

    A calibration made before is refused from then on: it holds the old table as its floor.

    Raises:
        InputError: nothing that moves, no provisional height, stopped, or no plane
        RobotError: see `touch_off`
    """
    if provisional_z is None:
        raise InputError(
            "give --table-z, a height [m] in the base frame that is 1 to 3 cm below the foam's top"
        )
    operator = operator or TerminalOperator()
    with robot or open_arm(config, TablePlane(provisional_z)) as arm:
        (x0, x1), (y0, y1) = arm.limits.x, arm.limits.y
        corners = [(x0, y0), (x0, y1), (x1, y1), (x1, y0), ((x0 + x1) / 2, 0.0)]
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        inside = [tuple(np.add(c, _INSET * np.sign(middle - c)).tolist()) for c in corners]
        confirm(
            operator,
            "clear the foam, nothing between the fingers, hand on the stop; the arm then goes "
            "home, homes its fingers and touches the foam at five points",
        )
        until_cleared(arm, operator, arm.home)
        if not arm.home_gripper():
            confirm(
                operator,
                f"home the hand in Desk, if it was switched on since: {config.robot} cannot do "
                "that from here",
            )
        points = touch(arm, inside)
        until_cleared(arm, operator, arm.home)
        arm.open_gripper()
    plane, residuals = fit_table_plane(points)
    path = config.setup / "table.json"
    workplace = workplace_of(config)
    workplace.save(config.setup)
    record = {
        "schema": 1,
        "height_m": plane.height_m,
        "slope_x": plane.slope_x,
        "slope_y": plane.slope_y,
        "workspace": [*workplace.x, *workplace.y],
        "points": points.tolist(),
        "residuals_m": residuals.tolist(),
    }
    write_json(path, record)
    return {
        "table": path,
        "height_m": float(plane.z(middle)),
        "worst_residual_m": float(np.abs(residuals).max()),
        "next": "calibrate camera, points or hand (again): the safety floor comes from there",
    }


def measure_camera(
    config: RigConfig,
    board: BoardSpec,
    *,
    corner_ids: tuple[int, ...],
    camera: Camera | None = None,
    robot: SafeRobot | None = None,
    operator: TerminalOperator | None = None,
) -> dict[str, Any]:
    """Find the board on the table and the arm's touches of its corners; fit and save.

    The arm goes home for the picture and closes its fingers. Then a person guides their tips onto
    each corner.

    Raises:
        InputError: the board is not seen, or the fit is worse than 3 mm
        RobotError, CameraError: robot or camera fail
    """
    operator = operator or TerminalOperator()
    table = touched_table(config)
    lens = lens_of(config)
    with robot or open_arm(config, table) as arm:
        close_at_home(arm, operator, "lay the board flat into the workspace")
        with camera or open_camera(config, lens) as device:
            frame = device.read()
        corners = find_corners(frame.rgb, board)
        hidden = sorted(set(corner_ids) - set(corners.ids.tolist()))
        if hidden:
            raise InputError(f"corners {hidden} are not seen; choose others with --corners")
        touched = []
        for corner in corner_ids:
            confirm(operator, f"guide the closed fingertips onto corner {corner} of the board")
            touched.append(arm.state().base_T_tcp[:2, 3])
    on_table = board_on_table(corners, board, np.array(corner_ids), np.array(touched))
    fit = fit_homography(corners.pixels, on_table, frame.intrinsics)
    calibration = make_calibration(
        config,
        frame.intrinsics,
        fit.base_H_pixel,
        table,
        method="charuco",
        error_m=fit.error_m,
        details={"board": board.to_record(), "report": fit.report()},
    )
    path = keep(config, calibration)
    write_picture(config.setup / "board_seen.png", marked(frame.rgb, corners.pixels))
    return {"calibration": path, "report": fit.report(), "error_m": fit.error_m}


def measure_hand_eye(
    config: RigConfig,
    board: BoardSpec,
    *,
    views: int = 15,
    camera: Camera | None = None,
    robot: SafeRobot | None = None,
    operator: TerminalOperator | None = None,
) -> dict[str, Any]:
    """Find a camera on the hand from pictures of a board that stands still; save.

    A person guides the hand from one view to the next; from the last the arm goes home. The table
    in the camera's picture from there follows from its height. Views are kept in `views.json` until
    the calibration is written: the next call goes on from them, and a refused one is taken again.

    Raises:
        InputError: too few views, stopped, or kept ones that are not of this setup
        RobotError, CameraError: robot or camera fail
    """
    _check_views(views, MIN_POSES)
    operator = operator or TerminalOperator()
    table = touched_table(config)
    lens = lens_of(config)
    with (
        robot or open_arm(config, table) as arm,
        camera or open_camera(config, lens) as device,
    ):
        intrinsics = device.read().intrinsics
        measured = hand_view_file(config, board, intrinsics)

        def take(index: int) -> HandView:
            count = max(views, len(measured.items), index + 1)
            text = (
                f"view {index + 1} of {count}: guide the hand so "
                "that it sees the board from elsewhere, tilted by some 25 degrees, and hold still"
            )
            while operator.wait(text):
                try:
                    corners = find_corners(device.read().rgb, board)
                    board_pose(corners, board, intrinsics)
                except InputError as error:
                    operator.wait(str(error))
                    continue
                return HandView(arm.state().base_T_tcp, corners)
            raise InputError("stopped before all views were taken")

        def fit(taken: list[HandView]) -> HandEye:
            camera_T_boards = []
            for index, view in enumerate(taken):
                try:
                    camera_T_boards.append(board_pose(view.corners, board, intrinsics))
                except InputError as error:  # of a kept view, after another lens
                    raise PoorFit(f"view {index + 1}: {error}", worst=index) from error
            return calibrate_hand_eye(
                np.array([v.base_T_tcp for v in taken]), np.array(camera_T_boards)
            )

        with measured.guarded():
            hand_eye = gather(measured, wanted=views, take=take, fit=fit, operator=operator)
            confirm(operator, "release the user stop; the arm then goes home")
            # What a person has guided and looked through must not be lost to a stop still pressed.
            until_cleared(arm, operator, arm.home)
            base_T_camera = arm.state().base_T_tcp @ hand_eye.tcp_T_camera
            calibration = make_calibration(
                config,
                intrinsics,
                plane_homography(intrinsics, base_T_camera, table),
                table,
                method="hand-eye",
                error_m=hand_eye.error_m,
                details={
                    "board": board.to_record(),
                    "report": hand_eye.report(),
                    "tcp_T_camera": hand_eye.tcp_T_camera.tolist(),
                },
            )
            path = keep(config, calibration)
        measured.remove()
    return {"calibration": path, "report": hand_eye.report(), "error_m": hand_eye.error_m}


def photograph_empty(config: RigConfig) -> dict[str, Any]:
    """Take the picture of the empty foam, for the segmentation; the arm must stand at home.

    Raises:
        InputError: there is no calibration yet
        CameraError: no picture
    """
    calibration = read_calibration(config)
    with open_camera(config, calibration.intrinsics) as device:
        view = calibration.workplace.view.rectify(device.read().rgb, calibration)
    path = config.setup / "empty_view.png"
    write_picture(path, view)
    return {"empty": path}


def _check_views(views: int, least: int) -> None:
    if views < least:
        raise InputError(f"--views is {views}; {least} are needed, 15 are better")
