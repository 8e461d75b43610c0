"""A synthetic camera over the table, and photographs of a ChArUco board."""

from __future__ import annotations

import cv2
import numpy as np

from hardware.arm.table_plane import TablePlane
from hardware.calibration.charuco import BoardSpec
from hardware.calibration.homography import apply_homography
from hardware.cameras.camera import CameraIntrinsics

SIZE = (1280, 720)
INTRINSICS = CameraIntrinsics(
    SIZE,
    np.array([[910.0, 0.0, 645.0], [0.0, 908.0, 355.0], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.08, 1e-3, -5e-4, 0.0]),
)
BOARD = BoardSpec()
TABLE = TablePlane(0.01, slope_x=0.004, slope_y=-0.006)


def rotation(*vector: float) -> np.ndarray:
    return cv2.Rodrigues(np.array(vector, dtype=float))[0]


def transform(R: np.ndarray, t: object) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def camera_above(
    tilt: tuple[float, float] = (0.03, -0.05), height: float = 0.62, yaw: float = 0.1
) -> np.ndarray:
    """base_T_camera of a camera over the workspace, looking down."""
    R = rotation(0, 0, yaw) @ rotation(*tilt, 0) @ np.diag([1.0, -1.0, -1.0])
    return transform(R, [0.485, 0.01, height])


def photograph(
    rng: np.random.Generator, camera_T_board: np.ndarray, *, noise: float = 5.0
) -> np.ndarray:
    """The board as the camera sees it, with distortion, blur and noise, (720, 1280, 3) uint8."""
    scale = 4000.0  # pixels of the print a metre
    margin = 60
    printed = cv2.copyMakeBorder(
        BOARD.picture(scale), *[margin] * 4, cv2.BORDER_CONSTANT, value=255
    )
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.stack([column, row], axis=-1).reshape(-1, 2)
    straight = INTRINSICS.undistort(pixels)
    to_board = np.linalg.inv(INTRINSICS.matrix @ camera_T_board[:3, [0, 1, 3]])
    at = apply_homography(to_board, straight) * scale + margin - 0.5
    maps = at.astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    # The print is finer than the picture: blur it first, as a lens and a pixel's area do.
    sharp = cv2.GaussianBlur(printed, (0, 0), 1.8)
    grey = cv2.remap(sharp, maps, None, cv2.INTER_LINEAR, borderValue=90).astype(float)
    light = np.linspace(0.7, 1.0, SIZE[0])
    noisy = np.clip(grey * light + rng.normal(0.0, noise, grey.shape), 0, 255).astype(np.uint8)
    return np.repeat(noisy[..., None], 3, axis=2)
