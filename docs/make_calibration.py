"""Draws what calibration pictures should look like, on a drawn board, with what is found in them.

python docs/make_calibration.py docs/images
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "shared"))

from fixtures.board_photographs import (
    BOARD,
    INTRINSICS,
    TABLE,
    camera_above,
    photograph,
    rotation,
    transform,
)

from hardware.arm.panda import HOME_Q
from hardware.calibration.calibration import Calibration
from hardware.calibration.charuco import find_corners
from hardware.calibration.homography import board_on_table, fit_homography
from hardware.vision.top_down_view import TopDownView
from warp_deform.errors import InputError

TILE = (320, 180)
GOOD, BAD, EDGE = (90, 220, 90), (255, 110, 90), (80, 170, 255)
TOUCHED = (0, 5, 18, 23)

# What to do, tilt [rad], the board's middle [m] in the camera's frame, and what spoils the picture.
VIEWS = (
    ("facing, near", (0.0, 0.0), (0.0, 0.0, 0.32), ""),
    ("tilted, left", (0.0, 0.5), (-0.16, 0.03, 0.48), ""),
    ("tilted, into a corner", (-0.5, -0.2), (0.17, -0.09, 0.46), ""),
    ("cut off", (0.2, 0.2), (0.38, 0.15, 0.45), ""),
    ("moved", (0.2, -0.3), (0.0, 0.0, 0.5), "blur"),
    ("glare", (0.3, 0.0), (0.0, 0.0, 0.42), "glare"),
)


def main() -> None:
    """Write both pictures into the folder that the command names."""
    folder = Path(sys.argv[1])
    _write(folder / "calibration_views.webp", views())
    _write(folder / "calibration_board.webp", board_on_foam())


def views() -> np.ndarray:
    """Six views for `calibrate lens` and `hand`: three to take, three that are refused."""
    rng = np.random.default_rng(0)
    middle = np.array([BOARD.columns, BOARD.rows, 0.0]) * BOARD.square_m / 2
    tiles = []
    for name, tilt, place, spoilt in VIEWS:
        R = rotation(*tilt, 0.1)
        rgb = _spoil(photograph(rng, transform(R, np.array(place) - R @ middle)), spoilt)
        try:
            corners = find_corners(rgb, BOARD).pixels
        except InputError:
            corners = np.zeros((0, 2))
        scale = TILE[0] / rgb.shape[1]
        tile = np.asarray(cv2.resize(rgb, TILE, interpolation=cv2.INTER_AREA))
        for column, row in np.rint(corners * scale).astype(int):
            cv2.circle(tile, (int(column), int(row)), 3, GOOD, -1, cv2.LINE_AA)
        total = len(BOARD.corners_m)
        tile[0], tile[:, 0] = 255, 255
        _label(tile, f"{name}: {len(corners)} of {total}", GOOD if len(corners) == total else BAD)
        tiles.append(tile)
    return np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])


def board_on_foam() -> np.ndarray:
    """`calibrate camera`: the picture from home with the corners to touch, and what comes of it."""
    rng = np.random.default_rng(1)
    base_T_camera = camera_above(yaw=np.pi / 2 + 0.1, height=0.74)
    base_T_board = transform(rotation(np.pi, 0, 0), [0.36, 0.10, TABLE.height_m])
    rgb = photograph(rng, np.linalg.inv(base_T_camera) @ base_T_board)
    corners = find_corners(rgb, BOARD)
    true = (BOARD.corners_m @ base_T_board[:3, :3].T + base_T_board[:3, 3])[:, :2]
    touched = true[list(TOUCHED)] + rng.normal(0.0, 5e-4, (len(TOUCHED), 2))
    placed = board_on_table(corners, BOARD, np.array(TOUCHED), touched)
    fit = fit_homography(corners.pixels, placed, INTRINSICS)
    calibration = Calibration(
        robot_id="",
        camera_id="",
        home_q=np.array(HOME_Q),
        intrinsics=INTRINSICS,
        base_H_pixel=fit.base_H_pixel,
        table=TABLE,
        method="charuco",
        error_m=fit.error_m,
    )
    view = TopDownView()
    (x0, x1), (y0, y1) = view.x, view.y
    rim = calibration.base_to_pixel(np.array([(x0, y0), (x0, y1), (x1, y1), (x1, y0)]))
    picture = rgb.copy()
    cv2.polylines(picture, [np.rint(rim).astype(np.int32)], True, EDGE, 3, cv2.LINE_AA)
    for number, pixel in zip(corners.ids.tolist(), corners.pixels, strict=True):
        at = (round(pixel[0]), round(pixel[1]))
        cv2.circle(picture, at, 9 if number in TOUCHED else 4, GOOD, -1, cv2.LINE_AA)
        if number in TOUCHED:  # its number beside the board
            side = 90 if pixel[0] > corners.pixels[:, 0].mean() else -130
            cv2.putText(
                picture,
                str(number),
                (at[0] + side, at[1] + 12),
                cv2.FONT_HERSHEY_SIMPLEX,
                1.3,
                BAD,
                3,
                cv2.LINE_AA,
            )
    small = np.asarray(cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA))
    _label(small, f"from home; left out {1e3 * fit.error_m:.1f} mm", GOOD)
    above = np.asarray(cv2.resize(view.rectify(rgb, calibration), (180, 360)))
    above[:, 0] = 255
    _label(above, "from above", GOOD)
    return np.hstack([small, above])


def _spoil(rgb: np.ndarray, how: str) -> np.ndarray:
    if how == "blur":
        return np.asarray(cv2.blur(rgb, (61, 3)))
    if how == "glare":
        y, x = np.mgrid[0 : rgb.shape[0], 0 : rgb.shape[1]]
        light = 500.0 * np.exp(-(((x - 660) / 260) ** 2 + ((y - 370) / 210) ** 2))
        return np.clip(rgb + light[..., None], 0, 255).astype(np.uint8)
    return rgb


def _label(picture: np.ndarray, text: str, color: tuple[int, int, int]) -> None:
    at = (6, picture.shape[0] - 8)
    for ink, thickness in (((0, 0, 0), 4), (color, 1)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, thickness, cv2.LINE_AA)


def _write(path: Path, rgb: np.ndarray) -> None:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(".webp", bgr, (cv2.IMWRITE_WEBP_QUALITY, 80))[1].tobytes())


if __name__ == "__main__":
    main()
