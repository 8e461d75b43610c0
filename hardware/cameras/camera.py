"""What every camera gives: frames with their intrinsics. Backends stand in `hardware.cameras`."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from warp_deform.errors import InputError, WarpDeformError

from ..support.closing import Closing
from ..support.frozen import freeze_arrays
from ..support.json_file import read_numbers

__all__ = [
    "DEPTH_UNIT",
    "Camera",
    "CameraError",
    "CameraIntrinsics",
    "FileCamera",
    "Frame",
    "read_image",
]

DEPTH_UNIT = 1e-4
"""Depth of one grey level in a stored depth picture [m]: 16 bits reach 6.5 m."""
_MAX_SIDE = 8192
_AT_ONCE = 4096  # points projected by one call
_NAME = re.compile(r"(\d+)_rgb\.png")


class CameraError(WarpDeformError):
    """A camera gave no picture; the message is one line and says what to do."""


@dataclass(frozen=True, eq=False)
class CameraIntrinsics:
    """How a camera projects.

    Attributes:
        size: width and height of its pictures [px]
        matrix: focal lengths and principal point [px], shape (3, 3)
        distortion: OpenCV's k1, k2, p1, p2, k3, ..., shape (n,); n is 0, 4, 5, 8, 12 or 14
    """

    size: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray

    def __post_init__(self) -> None:
        K, n = np.asarray(self.matrix), np.asarray(self.distortion).shape
        if not all(0 < side <= _MAX_SIDE for side in self.size):
            raise InputError(f"intrinsics: size {self.size} px; each side is 1 to {_MAX_SIDE}")
        if K.shape != (3, 3) or not np.isfinite(K).all() or not (K[0, 0] > 0 and K[1, 1] > 0):
            raise InputError("intrinsics: the matrix needs shape (3, 3) and focal lengths above 0")
        if not np.array_equal(K[2], [0, 0, 1]) or K[1, 0] != 0.0:
            raise InputError("intrinsics: the matrix's lower rows are not those of a camera matrix")
        if len(n) != 1 or n[0] not in (0, 4, 5, 8, 12, 14):
            raise InputError(f"intrinsics: distortion has shape {n}; OpenCV takes 4, 5, 8, 12, 14")
        if not np.isfinite(self.distortion).all():
            raise InputError("intrinsics: a distortion coefficient is not finite")
        freeze_arrays(self, "matrix", "distortion")

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Return where pixels (n, 2), column and row, would be without distortion."""
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        undistorted = cv2.undistortPointsIter(
            points,
            self.matrix,
            self.distortion if len(self.distortion) else None,
            None,
            self.matrix,
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9),
        )
        return np.asarray(undistorted).reshape(-1, 2)

    def distort(self, pixels: np.ndarray) -> np.ndarray:
        """Return where undistorted pixels (n, 2), column and row, are in the camera's picture."""
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(self.matrix).T
        distorted = np.empty_like(points)
        # OpenCV also differentiates each point, and few points at a time stay in the cache.
        for start in range(0, len(rays), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            at, _ = cv2.projectPoints(
                rays[part], np.zeros(3), np.zeros(3), self.matrix, self.distortion
            )
            distorted[part] = np.asarray(at).reshape(-1, 2)
        return distorted

    def to_record(self) -> dict[str, Any]:
        """Return the intrinsics as JSON types."""
        return {
            "size": list(self.size),
            "matrix": np.asarray(self.matrix, dtype=float).tolist(),
            "distortion": np.asarray(self.distortion, dtype=float).tolist(),
        }

    @classmethod
    def from_record(cls, record: Any, *, what: str) -> CameraIntrinsics:
        """Return what `to_record` gave; InputError, which begins with `what`, for anything else."""
        size = read_numbers(record, "size", (2,), what=what)
        if not all(float(side).is_integer() for side in size):
            raise InputError(f"{what}: size {size.tolist()} is not in whole pixels")
        return cls(
            (int(size[0]), int(size[1])),
            read_numbers(record, "matrix", (3, 3), what=what),
            read_numbers(record, "distortion", (-1,), what=what),
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture.

    Attributes:
        rgb: (H, W, 3) uint8
        depth_m: distance along the optical axis [m], (H, W) float32, 0 where unknown; None where
            the camera has no depth
        intrinsics: of the colour picture, to which depth is aligned
        timestamp_s: when it arrived [s since the epoch]
    """

    rgb: np.ndarray
    depth_m: np.ndarray | None
    intrinsics: CameraIntrinsics
    timestamp_s: float

    def __post_init__(self) -> None:
        width, height = self.intrinsics.size
        if self.rgb.shape != (height, width, 3) or self.rgb.dtype != np.uint8:
            raise CameraError(
                f"the camera gave a picture of shape {self.rgb.shape} and type {self.rgb.dtype}; "
                f"the intrinsics are for {width} x {height}: set that size or calibrate anew"
            )
        if self.depth_m is not None and self.depth_m.shape != (height, width):
            raise CameraError(
                f"the camera gave depth of shape {self.depth_m.shape} for a picture of "
                f"{width} x {height}; align it to the colour picture"
            )


class Camera(Closing, Protocol):
    """A source of frames."""

    def read(self) -> Frame:
        """Return a picture that was taken after this call.

        Raises:
            CameraError: none came in time
        """
        ...

    def close(self) -> None:
        """Let the device go; may be called twice."""
        ...


class FileCamera(Closing):
    """Replays recorded frames: `NNN_rgb.png`, and `NNN_depth.png` where there is one, in order.

    Args:
        folder: an episode's `frames`, or any folder of such files
        intrinsics: of the camera that took them

    Raises:
        InputError: no such files
    """

    def __init__(self, folder: Path, intrinsics: CameraIntrinsics) -> None:
        self._intrinsics = intrinsics
        self._next = 0
        if not folder.is_dir():
            raise InputError(f"{folder} is no folder; give the frames of a recorded episode")
        named = [(int(m[1]), p) for p in folder.iterdir() if (m := _NAME.fullmatch(p.name))]
        self._paths = [path for _, path in sorted(named)]
        if not self._paths:
            raise InputError(f"{folder} holds no pictures named like 000_rgb.png")

    def __len__(self) -> int:
        return len(self._paths)

    def read(self) -> Frame:
        """Return the next recorded frame; CameraError after the last."""
        if self._next >= len(self._paths):
            raise CameraError(f"the recording ended after {len(self._paths)} frames")
        path = self._paths[self._next]
        self._next += 1
        rgb = read_image(path, color=True)
        beside = path.with_name(path.name.replace("_rgb", "_depth"))
        depth = None
        if beside.exists():
            levels = read_image(beside, color=False)
            depth = (levels * DEPTH_UNIT).astype(np.float32)
        return Frame(rgb, depth, self._intrinsics, time.time())

    def close(self) -> None:
        """There is nothing to close."""


def read_image(path: Path, *, color: bool) -> np.ndarray:
    """Return a picture file: (H, W, 3) uint8 RGB, or (H, W) with the depth the file has.

    Raises:
        InputError: missing, damaged, or larger than 8192 pixels a side
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"the picture {path} cannot be read: {error.strerror}") from error
    # The size stands in a PNG's header; a damaged one must not make the decoder fill the memory.
    sides = [int.from_bytes(data[i : i + 4], "big") for i in (16, 20)]
    if data[:8] != b"\x89PNG\r\n\x1a\n" or not all(0 < side <= _MAX_SIDE for side in sides):
        raise InputError(f"the picture {path} is no PNG of at most {_MAX_SIDE} pixels a side")
    try:
        mode = cv2.IMREAD_COLOR if color else cv2.IMREAD_UNCHANGED
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise InputError(f"the picture {path} is damaged") from error
    if image is None or (not color and image.ndim != 2):
        raise InputError(f"the picture {path} is damaged or has the wrong number of channels")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if color else image)
