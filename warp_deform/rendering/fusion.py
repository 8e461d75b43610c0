"""Several RGB-D views into one top-down colour picture and height map.

Source: Seita et al., ICRA 2021 and their reference code, whose arithmetic this follows to the bit:
a cell is a point's position rounded down, the highest point of a camera fills its cell, heights are
merged by their maximum and colours by the mean over the cameras that saw something. Of equally
high points the last one of the picture wins here. In the original one of them wins, and which one
depends on the processor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from .camera import Camera
from .pixels import BOUNDS, PIXEL_SIZE, SHAPE

__all__ = ["fuse"]


def fuse(
    colors: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    segmentations: Sequence[np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fuse the views of `cameras` into top-down pictures.

    Args:
        colors: per camera (H, W, 3) uint8
        depths: per camera (H, W) float32 [m] along the viewing axis
        segmentations: per camera (H, W) uint8, or None

    Returns:
        color (320, 160, 3) uint8, height (320, 160) float32 [m] and segmentation (320, 160) uint8;
        all are 0 where no camera saw a point of the workspace.

    Raises:
        InputError: there is not one picture of the camera's size per camera.
    """
    views = [colors, depths] + ([] if segmentations is None else [segmentations])
    if not cameras or any(len(view) != len(cameras) for view in views):
        raise InputError(f"fuse needs one picture of each kind for each of {len(cameras)} cameras")
    maps = []
    for i, camera in enumerate(cameras):
        for name, image, depth in (("colour", colors[i], 3), ("depth", depths[i], 0)):
            wanted = (*camera.size, 3) if depth else camera.size
            if np.shape(image) != wanted:
                raise InputError(f"{name} picture {i} must be {wanted}, got {np.shape(image)}")
        maps.append(_splat(camera, depths[i]))
    height = np.max([heights for _, _, heights in maps], axis=0)
    total = np.zeros((*SHAPE, 3), np.float32)
    seen = np.zeros(SHAPE, np.float32)
    segmentation = np.zeros(SHAPE, np.uint8)
    for i, (cells, pixels, _) in enumerate(maps):
        color = np.zeros((SHAPE[0] * SHAPE[1], 3), np.uint8)
        color[cells] = np.asarray(colors[i]).reshape(-1, 3)[pixels]
        total += color.reshape(*SHAPE, 3)
        # black counts as unseen, as in the original
        seen += color.any(axis=1).reshape(SHAPE)
        if segmentations is not None:
            ids = np.zeros(SHAPE[0] * SHAPE[1], np.uint8)
            ids[cells] = np.asarray(segmentations[i]).reshape(-1)[pixels]
            segmentation = np.maximum(segmentation, ids.reshape(SHAPE))
    color = np.round(total / np.maximum(seen, 1)[..., None]).astype(np.uint8)
    return color, height, segmentation


def _splat(camera: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells (n,) and image pixels (n,) of the points that win a cell, and the height map [m]."""
    points = _points(camera, np.asarray(depth))
    low, high = np.array(BOUNDS).T
    inside = np.flatnonzero(((points >= low) & (points < high)).all(axis=1))
    points = points[inside]
    columns, rows = (
        np.floor((points[:, axis] - low[axis]) / PIXEL_SIZE).astype(np.int64) for axis in (0, 1)
    )
    cells = rows * SHAPE[1] + columns
    # the last assignment to a cell stays: ascending order leaves the highest point, and a stable
    # one the same point on every processor
    order = np.argsort(points[:, 2], kind="stable")
    winner = np.full(SHAPE[0] * SHAPE[1], -1)
    winner[cells[order]] = order
    cells = np.flatnonzero(winner >= 0)
    winner = winner[cells]
    height = np.zeros(SHAPE[0] * SHAPE[1], np.float32)
    height[cells] = points[winner, 2] - low[2]
    return cells, inside[winner], height.reshape(SHAPE)


def _points(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points (H * W, 3) float32 [m] of depths (H, W) [m], rounded as in the original."""
    K, pose = camera.intrinsics, camera.world_T_camera
    row, column = np.indices(depth.shape, dtype=float)
    points = np.stack(
        [(column - K[0, 2]) * (depth / K[0, 0]), (row - K[1, 2]) * (depth / K[1, 1]), depth],
        axis=-1,
    ).astype(np.float32)
    x, y, z = points.reshape(-1, 3).T.astype(float)
    world = [pose[i, 0] * x + pose[i, 1] * y + pose[i, 2] * z + pose[i, 3] for i in range(3)]
    return np.stack(world, axis=-1).astype(np.float32)
