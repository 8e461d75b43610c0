"""Where a fabric lies on the table: squares, and a corner turned over.

Pure functions of points; a planar pose is (3,) x, y [m], yaw [rad].
"""

from __future__ import annotations

import numpy as np

from ..rendering.pixels import SHAPE, pixel_to_world
from .target_shapes import to_world

__all__ = ["fold_corner", "square_corners", "square_mask"]

_UNIT_SQUARE = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
_PIXELS = pixel_to_world(np.moveaxis(np.indices(SHAPE), 0, -1))


def square_corners(pose: np.ndarray, side: float) -> np.ndarray:
    """Corners (4, 2) [m] of a square, in the order of `ClothConfig.inner_corners`.

    Examples:
        >>> square_corners(np.array([0.5, 0.0, 0.0]), 0.2).round(3).tolist()
        [[0.4, -0.1], [0.4, 0.1], [0.6, 0.1], [0.6, -0.1]]
    """
    return to_world(_UNIT_SQUARE * side / 2, pose)


def square_mask(pose: np.ndarray, side: float) -> np.ndarray:
    """Pixels (320, 160) bool whose points lie in a square: 64 x 64 of them for 0.2 m."""
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    local = (_PIXELS - [x, y]) @ np.array([[c, -s], [s, c]])
    return np.asarray((np.abs(local) < side / 2).all(axis=-1))


def fold_corner(points: np.ndarray, corner: int, depth: float, gap: float) -> np.ndarray:
    """The flat sheet `points` (P, 3) [m] with a corner turned over onto it.

    Args:
        corner: particle at it
        depth: of the fold line from it, towards the sheet's centre [m]
        gap: between the two layers [m], less where the sheet bends
    """
    points = np.array(points, dtype=float)
    xy = points[:, :2]
    inwards = xy.mean(axis=0) - xy[corner]
    inwards /= np.linalg.norm(inwards)
    over = np.maximum(depth - (xy - xy[corner]) @ inwards, 0.0)  # [m] beyond the fold line
    points[:, :2] += 2 * over[:, None] * inwards
    points[:, 2] += np.minimum(2 * over, gap)
    return points
