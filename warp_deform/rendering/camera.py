"""Pinhole cameras, and the three that the paper looks through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import InputError

__all__ = ["Camera", "look_at", "paper_cameras"]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion: x right, y down, z forward.

    Attributes:
        intrinsics: (3, 3) [pixels], the centre of pixel (row, column) is at v = row, u = column
        world_T_camera: (4, 4), pose of the camera in the world [m]
        size: rows and columns of its pictures

    Raises:
        InputError: a matrix has another shape, is not finite, or is no pinhole without skew.
    """

    intrinsics: np.ndarray
    world_T_camera: np.ndarray
    size: tuple[int, int] = (480, 640)

    def __post_init__(self) -> None:
        K, T = np.array(self.intrinsics, dtype=float), np.array(self.world_T_camera, dtype=float)
        if K.shape != (3, 3) or T.shape != (4, 4) or not np.isfinite([*K.flat, *T.flat]).all():
            raise InputError("a camera needs finite intrinsics (3, 3) and world_T_camera (4, 4)")
        if not (K[0, 0] > 0 and K[1, 1] > 0 and K[0, 1] == 0 and (K[2] == [0, 0, 1]).all()):
            raise InputError(f"intrinsics must be a pinhole's without skew, got {K.tolist()}")
        if min(self.size) < 1:
            raise InputError(f"a camera's size must be positive rows and columns, got {self.size}")
        K.flags.writeable = T.flags.writeable = False
        object.__setattr__(self, "intrinsics", K)
        object.__setattr__(self, "world_T_camera", T)


def look_at(
    eye: tuple[float, float, float],
    target: tuple[float, float, float],
    *,
    size: tuple[int, int],
    vertical_fov: float,
) -> Camera:
    """Camera at `eye` [m] that sees `target` [m] in the middle, the world's z axis up.

    Args:
        vertical_fov: opening angle from the top to the bottom of the picture [rad]
    """
    if not 0 < vertical_fov < np.pi:
        raise InputError(f"vertical_fov must be between 0 and pi, got {vertical_fov}")
    forward = np.subtract(target, eye).astype(float)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise InputError("look_at needs an eye that is not straight above or below its target")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = eye
    rows, columns = size
    focal = rows / 2 / np.tan(vertical_fov / 2)
    K = np.array([[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]])
    return Camera(K, pose, size)


def paper_cameras() -> tuple[Camera, Camera, Camera]:
    """The front, left and right RGB-D cameras of the benchmark.

    Source: Seita et al., ICRA 2021; angles are roll, pitch, yaw about the fixed axes.
    """
    K = np.array([[450.0, 0, 320], [0, 450, 240], [0, 0, 1]])
    cameras = []
    for position, angles in (
        ((1.0, 0.0, 0.75), (np.pi / 4, np.pi, -np.pi / 2)),
        ((0.0, 0.5, 0.75), (np.pi / 4.5, np.pi, np.pi / 4)),
        ((0.0, -0.5, 0.75), (np.pi / 4.5, np.pi, 3 * np.pi / 4)),
    ):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        pose[:3, 3] = position
        cameras.append(Camera(K, pose))
    front, left, right = cameras
    return front, left, right
