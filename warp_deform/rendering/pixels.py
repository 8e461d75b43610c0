"""The top-down picture's grid: which point of the table every pixel stands for.

Row u runs along y and column v along x. A pixel is centred on its point, so `pixel_to_world` and
`world_to_pixel` (which rounds) undo each other and agree with what is drawn.

Source: Seita et al., ICRA 2021 (workspace bounds, 3.125 mm pixels).
"""

from __future__ import annotations

import numpy as np

__all__ = ["BOUNDS", "PIXEL_SIZE", "SHAPE", "pixel_to_world", "world_to_pixel"]

BOUNDS = ((0.25, 0.75), (-0.5, 0.5), (0.0, 0.28))
"""Workspace [m]: (min, max) along x, y, z, in the frame of the robot's base."""
PIXEL_SIZE = 0.003125
"""Side of a pixel on the table [m]."""
SHAPE = (320, 160)
"""Rows (y) and columns (x) of a top-down picture."""


def pixel_to_world(pixel: np.ndarray) -> np.ndarray:
    """World x, y [m] of pixels (..., 2), given as row u and column v: float64 (..., 2).

    >>> pixel_to_world(np.array([160, 80])).tolist()
    [0.5, 0.0]
    """
    pixel = np.asarray(pixel, dtype=float)
    x = BOUNDS[0][0] + pixel[..., 1] * PIXEL_SIZE
    y = BOUNDS[1][0] + pixel[..., 0] * PIXEL_SIZE
    return np.stack([x, y], axis=-1)


def world_to_pixel(xy: np.ndarray) -> np.ndarray:
    """Nearest pixel (row u, column v) of world points (..., 2) [m]: int64 (..., 2).

    A point outside of the picture gets a pixel outside of `SHAPE`; nothing is clamped.

    >>> world_to_pixel(np.array([0.5, 0.0])).tolist()
    [160, 80]
    """
    xy = np.asarray(xy, dtype=float)
    u = np.round((xy[..., 1] - BOUNDS[1][0]) / PIXEL_SIZE)
    v = np.round((xy[..., 0] - BOUNDS[0][0]) / PIXEL_SIZE)
    return np.stack([u, v], axis=-1).astype(np.int64)
