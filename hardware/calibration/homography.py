"""From pixels to points on the table: a homography, because the cable lies on a plane.

All pictures are taken from one home pose, so no pose of the camera enters, and no chain of errors.
Every point is also predicted from the others ("leave one out"): that is the error to expect where
no point was measured, which the fit's own residual is not.

Source: Hartley and Zisserman, "Multiple View Geometry", 2004, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from warp_deform.errors import InputError

from ..arm.table_plane import TablePlane
from ..cameras.camera import CameraIntrinsics
from .charuco import BoardSpec, Corners
from .poor_fit import PoorFit

__all__ = [
    "MAX_ERROR",
    "MIN_POINTS",
    "HomographyFit",
    "apply_homography",
    "board_on_table",
    "fit_homography",
    "plane_homography",
    "solve_homography",
]

MIN_POINTS = 5
"""Fewest points that give a result: four always fit, a fifth says whether they fit well."""
MAX_ERROR = 3e-3
"""Greatest error of a calibration [m], rms, by its own measure: half of a cable's width."""
# With fewer points some four or five always fit well by chance.
_MIN_TO_BLAME = 7
# How many times smaller the noise of the others must be: right points reach 1.7 of 9 by chance, one
# that is 12 mm off 2.8 at least (both 5 %).
_BLAME = 2.0
_MIN_SPREAD = 0.02  # [m], standard deviation across the narrow side of the points
_MAX_BOARD_ERROR = 2e-3  # [m]


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A homography and how good it is.

    Attributes:
        base_H_pixel: from undistorted pixels (column, row, 1) to base x, y [m], shape (3, 3)
        residuals_m: of every point, shape (n,)
        left_out_m: error at every point of the fit to all others, shape (n,)
        others_m: how well all others fit one another, root mean square, shape (n,)
    """

    base_H_pixel: np.ndarray
    residuals_m: np.ndarray
    left_out_m: np.ndarray
    others_m: np.ndarray

    @property
    def error_m(self) -> float:
        """Root mean square of `left_out_m` [m]."""
        return math.sqrt(float((self.left_out_m**2).mean()))

    @property
    def worst(self) -> int | None:
        """Index of the point without which the others fit much better; None where there is none.

        A wrong point also bends the fit that predicts the right ones at the rim, so the largest of
        `left_out_m` is often that of a right one. What is compared is the noise that each fit
        finds, by its degrees of freedom: two for each point less the homography's eight.
        """
        count, wrong = len(self.others_m), int(np.argmin(self.others_m))
        if count < _MIN_TO_BLAME:
            return None
        noise = math.sqrt(float((self.residuals_m**2).sum()) / (2 * count - 8))
        without = float(self.others_m[wrong]) * math.sqrt((count - 1) / (2 * count - 10))
        return wrong if noise > _BLAME * without else None

    def check(self) -> None:
        """Raise PoorFit where the error exceeds `MAX_ERROR`."""
        if self.error_m <= MAX_ERROR:
            return
        worst = self.worst
        advice = "no one point is to blame: measure more, farther apart"
        if worst is not None:
            advice = f"measure point {worst + 1} again first"
        raise PoorFit(
            f"{self.report()}; allowed: {1e3 * MAX_ERROR:g} mm rms, so it is refused; {advice}",
            worst=worst,
        )

    def report(self) -> str:
        """Return the figures as a line for people."""
        return (
            f"homography of {len(self.residuals_m)} points: left out "
            f"{1e3 * self.error_m:.2f} mm rms, {1e3 * self.left_out_m.max():.2f} mm at most; "
            f"residual {1e3 * float(np.sqrt((self.residuals_m**2).mean())):.2f} mm rms"
        )


def apply_homography(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 2) mapped by H (3, 3)."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ np.asarray(H).T
    projected: np.ndarray = mapped[:, :2] / mapped[:, 2:]
    return projected


def fit_homography(
    pixels: np.ndarray, base_xy: np.ndarray, intrinsics: CameraIntrinsics
) -> HomographyFit:
    """Return what `solve_homography` does, if it is good enough.

    Raises:
        InputError: see `solve_homography`
        PoorFit: more than 3 mm off, left out
    """
    fit = solve_homography(pixels, base_xy, intrinsics)
    fit.check()
    return fit


def solve_homography(
    pixels: np.ndarray, base_xy: np.ndarray, intrinsics: CameraIntrinsics
) -> HomographyFit:
    """Return the homography through points seen at `pixels` and standing at `base_xy`, (n, 2) each.

    Args:
        pixels: column and row in the camera's picture, distorted as it is [px]
        base_xy: where the closed gripper touched them, or the board's corners [m]
        intrinsics: of the camera

    Raises:
        InputError: fewer than five points, all near a line, or seen from below
    """
    pixels, base_xy = np.asarray(pixels, dtype=float), np.asarray(base_xy, dtype=float)
    if pixels.shape != base_xy.shape or pixels.ndim != 2 or pixels.shape[1] != 2:
        raise InputError(f"pixels {pixels.shape} and points {base_xy.shape} need shape (n, 2) both")
    if len(pixels) < MIN_POINTS:
        raise InputError(
            f"{len(pixels)} points: four fit any homography, so {MIN_POINTS} are needed to see "
            "whether they are right; touch more"
        )
    if not (np.isfinite(pixels).all() and np.isfinite(base_xy).all()):
        raise InputError("a pixel or a touched point is not finite; measure it again")
    spread = np.linalg.svd(base_xy - base_xy.mean(axis=0), compute_uv=False)[1]
    if spread / math.sqrt(len(pixels)) < _MIN_SPREAD:
        raise InputError("the points lie near a line; spread them over the workspace")
    straight = intrinsics.undistort(pixels)
    H = _solve(straight, base_xy)
    # Rows run downwards, so a table seen from above is mirrored: its Jacobian's determinant,
    # det(H) / w^3, is negative.
    if np.linalg.det(H) * (H[2] @ [*straight.mean(axis=0), 1.0]) > 0.0:
        raise InputError(
            "the points run the wrong way round, as if seen from below; are column and row, or x "
            "and y, swapped?"
        )
    residuals = np.linalg.norm(apply_homography(H, straight) - base_xy, axis=1)
    left_out, among_others = np.empty(len(pixels)), np.empty(len(pixels))
    for i in range(len(pixels)):
        others = np.arange(len(pixels)) != i
        predicted = apply_homography(_solve(straight[others], base_xy[others]), straight)
        errors = np.linalg.norm(predicted - base_xy, axis=1)
        left_out[i] = errors[i]
        among_others[i] = math.sqrt(float((errors[others] ** 2).mean()))
    return HomographyFit(H, residuals, left_out, among_others)


def board_on_table(
    corners: Corners, board: BoardSpec, touched_ids: np.ndarray, touched_xy: np.ndarray
) -> np.ndarray:
    """Return where found corners stand in the base frame (n, 2) [m], from a few touched ones.

    Args:
        corners: what the camera sees
        board: the board, flat on the table
        touched_ids: numbers of three or more touched corners, (m,)
        touched_xy: where the closed gripper touched them [m], (m, 2)

    Raises:
        InputError: too few, near a line, or they do not have the board's distances

    Source: Kabsch's algorithm in the plane.
    """
    on_board = board.corners_m[:, :2]
    ids, xy = np.asarray(touched_ids), np.asarray(touched_xy, dtype=float)
    if len(ids) < 3 or xy.shape != (len(ids), 2) or len(set(ids.tolist())) < len(ids):
        raise InputError("touch three or more different corners of the board, x and y of each")
    if ids.min() < 0 or ids.max() >= len(on_board):
        raise InputError(f"the board's corners have numbers 0 to {len(on_board) - 1}")
    source = on_board[ids]
    if np.linalg.svd(source - source.mean(axis=0), compute_uv=False)[1] < board.square_m:
        raise InputError("the touched corners lie near a line; take some far from it")
    covariance = (xy - xy.mean(axis=0)).T @ (source - source.mean(axis=0))
    u, _, v = np.linalg.svd(covariance)
    # The board's y axis points down its picture: seen from above in a frame whose z points up it is
    # mirrored, so the best orthogonal matrix is taken, whatever its determinant.
    R = u @ v
    shift = xy.mean(axis=0) - R @ source.mean(axis=0)
    errors = np.linalg.norm(source @ R.T + shift - xy, axis=1)
    if not errors.max() <= _MAX_BOARD_ERROR:
        raise InputError(
            f"touched corner {int(ids[np.argmax(errors)])} is {1e3 * errors.max():.1f} mm from "
            f"where the others put it (allowed: {1e3 * _MAX_BOARD_ERROR:g} mm); touch it again, "
            "and measure the print's squares"
        )
    placed: np.ndarray = on_board[corners.ids] @ R.T + shift
    return placed


def plane_homography(
    intrinsics: CameraIntrinsics, base_T_camera: np.ndarray, table: TablePlane
) -> np.ndarray:
    """Return base_H_pixel (3, 3) of a camera whose pose in the base frame is known, by hand-eye.

    Raises:
        InputError: the camera does not look down on the table
    """
    camera_T_base = np.linalg.inv(base_T_camera)
    # A point of the table is (x, y, height + slope_x x + slope_y y): linear in (x, y, 1).
    lift = np.array(
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [table.slope_x, table.slope_y, table.height_m]]
    )
    in_camera = camera_T_base[:3, :3] @ lift
    in_camera[:, 2] += camera_T_base[:3, 3]
    pixel_H_base = intrinsics.matrix @ in_camera
    looks_down = base_T_camera[2, 2] < 0.0 and base_T_camera[2, 3] > table.z(base_T_camera[:2, 3])
    if not looks_down or abs(np.linalg.det(pixel_H_base)) < 1e-9:
        raise InputError("the camera does not look down on the table; check the hand-eye pose")
    H = np.linalg.inv(pixel_H_base)
    normalised: np.ndarray = H / H[2, 2]
    return normalised


def _solve(pixels: np.ndarray, base_xy: np.ndarray) -> np.ndarray:
    """Return the least-squares homography; scaled so that the errors are in micrometres."""
    H, _ = cv2.findHomography(pixels, base_xy * 1e6, 0)
    if H is None or not np.isfinite(H).all():
        raise InputError("the points fit no homography; spread them over the workspace")
    scaled: np.ndarray = np.diag([1e-6, 1e-6, 1.0]) @ H
    return scaled
