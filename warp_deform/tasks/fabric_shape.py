"""Where a fabric lies on the table: squares, and a corner turned over.

Pure functions of points; a planar pose is (3,) x, y [m], yaw [rad].
"""

from __future__ import annotations

import numpy as np

from ..rendering.pixels import SHAPE, pixel_to_world
from .target_shapes import to_world

__all__ = ["fold_corner", "fold_over", "square_corners", "square_mask"]

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


def fold_over(points: np.ndarray, pick: np.ndarray, place: np.ndarray, gap: float) -> np.ndarray:
    """A sheet, folded before or not, with all of it beyond a line turned over onto the rest.

    Layers that are turned over lie above all others, in falling order.

    Args:
        points: of the sheet (P, 3) [m]
        pick: a point (2 or 3,) that comes to lie on `place`; the line is halfway between them
        gap: between two layers [m], less where the sheet bends
    """
    points = np.array(points, dtype=float)
    way = np.subtract(place, pick)[:2]
    length = np.linalg.norm(way)
    over = np.maximum(length / 2 - (points[:, :2] - pick[:2]) @ way / length, 0.0)
    turned = over > 0
    points[:, :2] += 2 * over[:, None] * way / length
    if turned.any() and not turned.all():
        z = points[turned, 2]
        above = points[~turned, 2].max() + gap + z.max() - z
        points[turned, 2] = z + np.minimum(2 * over[turned], above - z)
    return points
