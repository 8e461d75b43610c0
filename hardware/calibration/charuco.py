"""The ChArUco board: finding its corners in a picture, where it is, and printing it.

Source: Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial
markers under occlusion", 2014; OpenCV's aruco module.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from warp_deform.errors import InputError

from ..cameras.camera import CameraIntrinsics
from .poor_fit import PoorFit

__all__ = [
    "MIN_VIEWS",
    "BoardSpec",
    "Corners",
    "board_pose",
    "calibrate_intrinsics",
    "find_corners",
]

_MIN_CORNERS = 6
_MAX_POSE_ERROR = 2.0  # [px], root mean square
MIN_VIEWS = 8
"""Fewest views that give intrinsics."""
_MAX_INTRINSICS_ERROR = 1.0  # [px]


@dataclass(frozen=True, kw_only=True)
class BoardSpec:
    """A printed board; measure the print, printers scale."""

    columns: int = 7
    """Squares along x."""
    rows: int = 5
    """Squares along y."""
    square_m: float = 0.036
    """Side of a square [m]: 7 x 5 of them fit on A4."""
    marker_m: float = 0.026
    """Side of a marker [m]."""

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 20 and 3 <= self.rows <= 20):
            raise InputError(f"a board has 3 to 20 squares a side, not {self.columns}, {self.rows}")
        if not 0.0 < self.marker_m < self.square_m <= 0.5:
            raise InputError("a board needs 0 < marker_m < square_m <= 0.5 m")

    @property
    def corners_m(self) -> np.ndarray:
        """Inner corners on the board [m], ((columns - 1) (rows - 1), 3), z = 0, by number."""
        return np.asarray(self.board().getChessboardCorners(), dtype=np.float64)

    def board(self) -> Any:
        """Return OpenCV's board."""
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)

    def picture(self, pixels_per_metre: float) -> np.ndarray:
        """Return the board to print, uint8 (rows, columns), without a margin."""
        size = [round(n * self.square_m * pixels_per_metre) for n in (self.columns, self.rows)]
        return np.asarray(self.board().generateImage(size))

    def to_record(self) -> dict[str, Any]:
        """Return the board as JSON types."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Corners:
    """Found corners.

    Attributes:
        ids: numbers of the corners, shape (n,)
        pixels: column and row in the picture [px], shape (n, 2)
    """

    ids: np.ndarray
    pixels: np.ndarray


def find_corners(rgb: np.ndarray, board: BoardSpec) -> Corners:
    """Return the board's corners in a picture (H, W, 3) uint8.

    Raises:
        InputError: fewer than six are seen
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(board.board()).detectBoard(grey)
    count = 0 if ids is None else len(ids)
    if count < _MIN_CORNERS:
        total = (board.columns - 1) * (board.rows - 1)
        raise InputError(
            f"{count} of the board's {total} corners are seen, {_MIN_CORNERS} are needed; more "
            "light, no glare, the whole board in the picture; check that it is the configured board"
        )
    return Corners(ids.ravel(), np.asarray(pixels, dtype=np.float64).reshape(-1, 2))


def board_pose(corners: Corners, board: BoardSpec, intrinsics: CameraIntrinsics) -> np.ndarray:
    """Return camera_T_board (4, 4) [m].

    Raises:
        InputError: the corners do not fit such a board at any pose
    """
    points = board.corners_m[corners.ids]
    K, distortion = intrinsics.matrix, intrinsics.distortion
    solved, r, t = cv2.solvePnP(points, corners.pixels, K, distortion, flags=cv2.SOLVEPNP_IPPE)
    if solved:
        r, t = cv2.solvePnPRefineLM(points, corners.pixels, K, distortion, r, t)
        again, _ = cv2.projectPoints(points, r, t, K, distortion)
        errors = again.reshape(-1, 2) - corners.pixels
        rms = math.sqrt(float((errors**2).sum(axis=1).mean()))
    if not solved or not rms <= _MAX_POSE_ERROR:
        raise InputError(
            "the corners fit no pose of the board; check its squares' size and the intrinsics"
        )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
    return T


def calibrate_intrinsics(
    views: list[Corners], board: BoardSpec, size: tuple[int, int]
) -> tuple[CameraIntrinsics, float]:
    """Return a camera's intrinsics from views of the board, and their error [px], rms.

    Args:
        views: eight or more, from different sides, near and far, into the corners of the picture
        board: as it is printed
        size: width and height of the pictures [px]

    Raises:
        InputError: too few views
        PoorFit: they do not fit together to 1 px rms

    Source: Zhang, "A flexible new technique for camera calibration", 2000.
    """
    if len(views) < MIN_VIEWS:
        raise InputError(f"intrinsics need {MIN_VIEWS} views of the board, not {len(views)}")
    objects = [board.corners_m[view.ids].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    rms, K, distortion, *_, errors = cv2.calibrateCameraExtended(objects, pixels, size, None, None)
    if not rms <= _MAX_INTRINSICS_ERROR:
        worst = int(np.argmax(errors))
        raise PoorFit(
            f"the views fit together to {rms:.2f} px only ({_MAX_INTRINSICS_ERROR:g} allowed); "
            f"take view {worst + 1} again first; glue the board on something flat, hold the camera "
            "still",
            worst=worst,
        )
    return CameraIntrinsics(size, K, distortion.ravel()), float(rms)
