"""The top-down picture's grid: which point of the table every pixel stands for.

Row u runs along y and column v along x. A pixel is centred on its point, so `pixel_to_world` and
`world_to_pixel` (which rounds) undo each other and agree with what is drawn.

Source: Seita et al., ICRA 2021 (workspace bounds, 3.125 mm pixels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = [
    "BOUNDS",
    "PIXEL_SIZE",
    "SHAPE",
    "TABLE_GRID",
    "PixelGrid",
    "pixel_to_world",
    "world_to_pixel",
]

BOUNDS = ((0.25, 0.75), (-0.5, 0.5), (0.0, 0.28))
"""Workspace [m]: (min, max) along x, y, z, in the frame of the robot's base."""
PIXEL_SIZE = 0.003125
"""Side of a pixel on the table [m]."""
SHAPE = (320, 160)
"""Rows (y) and columns (x) of a top-down picture."""


@dataclass(frozen=True)
class PixelGrid:
    """Which point of the table every pixel of a picture of `SHAPE` is centred on.

    Attributes:
        origin: x, y [m] of pixel (0, 0)
        pixel_size: side of a pixel [m]
    """

    origin: tuple[float, float]
    pixel_size: float

    def to_world(self, pixel: np.ndarray) -> np.ndarray:
        """World x, y [m] of pixels (..., 2), given as row u and column v: float64 (..., 2)."""
        pixel = np.asarray(pixel, dtype=float)
        x = self.origin[0] + pixel[..., 1] * self.pixel_size
        y = self.origin[1] + pixel[..., 0] * self.pixel_size
        return np.stack([x, y], axis=-1)

    def fractional(self, xy: np.ndarray) -> np.ndarray:
        """Row u and column v, not rounded, of world points (..., 2) [m]: float64 (..., 2)."""
        xy = np.asarray(xy, dtype=float)
        u = (xy[..., 1] - self.origin[1]) / self.pixel_size
        v = (xy[..., 0] - self.origin[0]) / self.pixel_size
        return np.stack([u, v], axis=-1)

    def to_pixel(self, xy: np.ndarray) -> np.ndarray:
        """Nearest pixel of world points (..., 2) [m]: int64 (..., 2).

        A point outside of the picture gets a pixel outside of `SHAPE`; nothing is clamped.
        """
        return np.round(self.fractional(xy)).astype(np.int64)

    def in_view(self, xy: np.ndarray) -> np.ndarray:
        """The nearest world points (..., 2) [m] that a picture of `SHAPE` shows, to the bit.

        A policy cannot be taught to act where its picture ends.
        """
        first, last = self.to_world(np.zeros(2)), self.to_world(np.array(SHAPE) - 1.0)
        return np.clip(np.asarray(xy, dtype=float), first, last)


TABLE_GRID = PixelGrid((BOUNDS[0][0], BOUNDS[1][0]), PIXEL_SIZE)
"""The grid of the benchmark's pictures."""


def pixel_to_world(pixel: np.ndarray) -> np.ndarray:
    """`TABLE_GRID.to_world`.

    Examples:
        >>> pixel_to_world(np.array([160, 80])).tolist()
        [0.5, 0.0]
    """
    return TABLE_GRID.to_world(pixel)


def world_to_pixel(xy: np.ndarray) -> np.ndarray:
    """`TABLE_GRID.to_pixel`.

    Examples:
        >>> world_to_pixel(np.array([0.5, 0.0])).tolist()
        [160, 80]
    """
    return TABLE_GRID.to_pixel(xy)
