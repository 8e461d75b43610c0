"""Where on the table something can still be placed, within the robot's reach.

Source: Seita et al., ICRA 2021 (`random_pose`). The original renders a segmentation to find free
pixels; here occupied shapes are drawn into a mask, so nothing is rendered, and a full table is a
typed error instead of a crash.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeVar

import cv2
import numpy as np

from ..errors import InputError, WarpDeformError
from ..rendering.pixels import BOUNDS, PIXEL_SIZE, SHAPE, pixel_to_world

__all__ = ["FreeSpace", "NoFreeSpace", "first_that_fits"]

T = TypeVar("T")

_LOW, _HIGH = np.array(BOUNDS[:2]).T
_SUBPIXEL_BITS = 4  # polygon corners are rounded to 1/16 pixel


class NoFreeSpace(WarpDeformError):
    """Nothing of the wanted size fits on what is left of the table."""


def first_that_fits(draw: Callable[[], T], *, tries: int = 50) -> T:
    """What `draw` returns, which places things one after the other, in the first try with room.

    Raises:
        NoFreeSpace: that of the last try.
    """
    for _ in range(tries - 1):
        try:
            return draw()
        except NoFreeSpace:
            continue
    return draw()


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Table pixels that are free and within reach. Values never change: `occupy_*` return new ones.

        space = FreeSpace(reach=(0.2, 0.9))
        space = space.occupy_disc((0.5, 0.0), 0.1)
        x, y, yaw = space.sample(rng, 0.04, 0.04)

    Attributes:
        reach: least and largest horizontal distance from the robot's base [m]; None = everywhere
        occupied: pixels that something covers (320, 160) bool
    """

    reach: tuple[float, float] | None = None
    occupied: np.ndarray = field(default_factory=lambda: np.zeros(SHAPE, dtype=bool), repr=False)

    def __post_init__(self) -> None:
        if self.reach is not None and not 0 <= self.reach[0] < self.reach[1] < math.inf:
            raise InputError(f"reach needs 0 <= least < largest [m], got {self.reach}")
        if self.occupied.shape != SHAPE or self.occupied.dtype != bool:
            raise InputError(f"occupied needs bool of shape {SHAPE}, got {self.occupied.shape}")

    @property
    def free(self) -> np.ndarray:
        """Mask (320, 160) bool of pixels that are neither covered nor out of reach."""
        return ~self.occupied & self._within_reach(0.0)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of `points` (..., 2) [m] lie on the table and within reach, covered or not."""
        xy = np.asarray(points, dtype=float)
        inside = ((xy >= _LOW) & (xy <= _HIGH)).all(axis=-1)
        if self.reach is None:
            return inside
        distance = np.hypot(xy[..., 0], xy[..., 1])
        return inside & (distance >= self.reach[0]) & (distance <= self.reach[1])

    def occupy_disc(self, centre: tuple[float, float] | np.ndarray, radius: float) -> FreeSpace:
        """This space less a disc around `centre` (2,) of `radius` [m]."""
        distance = np.linalg.norm(_PIXELS - np.asarray(centre, dtype=float), axis=-1)
        return replace(self, occupied=self.occupied | (distance <= radius))

    def occupy_polygon(self, points: np.ndarray) -> FreeSpace:
        """This space less the inside and the rim of the polygon `points` (n, 2 or 3) [m]."""
        return self.occupy_quads(np.asarray(points, dtype=float)[None])

    def occupy_quads(self, corners: np.ndarray) -> FreeSpace:
        """This space less polygons, `corners` (q, n, 2 or 3) [m]: a zone's corners, say."""
        mask = self.occupied.astype(np.uint8)
        pixels = (np.asarray(corners, dtype=float)[..., :2] - _LOW) / PIXEL_SIZE
        if not np.isfinite(pixels).all():
            raise InputError("a polygon that occupies the table needs finite corners")
        for polygon in np.rint(pixels * 2**_SUBPIXEL_BITS).astype(np.int32):
            cv2.fillPoly(mask, [polygon], 1, shift=_SUBPIXEL_BITS)
        return replace(self, occupied=mask.astype(bool))

    def sample(
        self,
        rng: np.random.Generator,
        size_x: float,
        size_y: float,
        *,
        extent: float | None = None,
    ) -> tuple[float, float, float]:
        """Draw x, y [m] and yaw [rad] where a box of `size_x` x `size_y` [m] fits at any yaw.

        The free table is eroded by a square as wide as the box's diagonal and a pixel drawn
        uniformly from what is left, as in the original. The circle of radius `extent` [m] about it
        (default: the circle around the box) lies within reach.

        Raises:
            NoFreeSpace: no pixel is left.
        """
        diagonal = math.hypot(size_x, size_y)
        width = max(1, round(diagonal / PIXEL_SIZE))
        mask = (~self.occupied).astype(np.uint8)
        mask[[0, -1], :] = mask[:, [0, -1]] = 0
        mask = cv2.erode(mask, np.ones((width, width), np.uint8))
        pixels = np.argwhere(
            mask.astype(bool) & self._within_reach(diagonal / 2 if extent is None else extent)
        )
        if not len(pixels):
            raise NoFreeSpace(
                f"no free place for {size_x:.3g} x {size_y:.3g} m on the table (reach "
                f"{self.reach or 'unlimited'}): make the objects smaller or fewer"
            )
        x, y = pixel_to_world(pixels[rng.integers(len(pixels))])
        return float(x), float(y), float(rng.uniform(0.0, 2 * np.pi))

    def _within_reach(self, margin: float) -> np.ndarray:
        """Pixels (320, 160) whose surrounding circle of radius `margin` [m] is within reach."""
        if self.reach is None:
            return np.ones(SHAPE, dtype=bool)
        return (_DISTANCE - margin >= self.reach[0]) & (_DISTANCE + margin <= self.reach[1])


_PIXELS = pixel_to_world(np.moveaxis(np.indices(SHAPE), 0, -1))
_DISTANCE = np.linalg.norm(_PIXELS, axis=-1)
