"""The workspace seen from straight above, as the simulator draws it: rows along y, columns along x.

A policy gets this picture, and an action's pixel means the same in it for every camera. Pixels are
square and of one size, so a tangent in the picture is a tangent on the table.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import PixelGrid

__all__ = ["Projection", "TopDownView"]


class Projection(Protocol):
    """Where points of the table are in a camera's picture; a calibration is one."""

    def __hash__(self) -> int: ...  # what was computed from it is kept

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the picture [px]."""

    def base_to_pixel(self, xy: np.ndarray) -> np.ndarray:
        """Column and row (..., 2) [px] of x, y (..., 2) [m] in the base frame."""


@dataclass(frozen=True, kw_only=True)
class TopDownView:
    """A rectangle of the table and its grid of pixels; each pixel is centred on its point."""

    x: tuple[float, float] = (0.335, 0.635)
    """Workspace along x [m]: the outer edges of the first and last column."""
    y: tuple[float, float] = (-0.30, 0.30)
    """Workspace along y [m]: the outer edges of the first and last row."""
    shape: tuple[int, int] = (320, 160)
    """Rows and columns."""

    def __post_init__(self) -> None:
        if not (self.x[0] < self.x[1] and self.y[0] < self.y[1] and min(self.shape) > 0):
            raise InputError(f"a view needs x and y as (low, high) and a shape, not {self}")
        across = (self.x[1] - self.x[0]) / self.shape[1]
        if abs((self.y[1] - self.y[0]) / self.shape[0] / across - 1.0) > 1e-6:
            raise InputError(f"a view needs square pixels; {self} has none")

    @property
    def grid(self) -> PixelGrid:
        """The same pixels as the simulated tasks name them."""
        half = 0.5 * self.pixel_m
        return PixelGrid((self.x[0] + half, self.y[0] + half), self.pixel_m)

    @property
    def pixel_m(self) -> float:
        """Side of a pixel [m]."""
        return (self.x[1] - self.x[0]) / self.shape[1]

    def pixel_to_base(self, pixels: np.ndarray) -> np.ndarray:
        """Return base x, y [m] of pixels (..., 2), row and column, fractions allowed."""
        pixels = np.asarray(pixels, dtype=float)
        x = self.x[0] + (pixels[..., 1] + 0.5) * self.pixel_m
        y = self.y[0] + (pixels[..., 0] + 0.5) * self.pixel_m
        return np.stack([x, y], axis=-1)

    def base_to_pixel(self, xy: np.ndarray) -> np.ndarray:
        """Return row and column, not rounded, of base x, y (..., 2) [m]."""
        xy = np.asarray(xy, dtype=float)
        row = (xy[..., 1] - self.y[0]) / self.pixel_m - 0.5
        column = (xy[..., 0] - self.x[0]) / self.pixel_m - 0.5
        return np.stack([row, column], axis=-1)

    def rectify(
        self, image: np.ndarray, projection: Projection, *, supersample: int = 2
    ) -> np.ndarray:
        """Return a camera's picture (h, w, 3) or (h, w) uint8 seen from above, `shape` (, 3).

        Args:
            image: the picture
            projection: where points of the table are in it
            supersample: samples a pixel and side; they are averaged, so thin cables keep their
                width

        Raises:
            InputError: part of the workspace is outside of the picture
        """
        sample_pixels = _samples(self, projection, supersample)
        height, width = image.shape[:2]
        if (width, height) != projection.picture_size:
            raise InputError(
                f"the picture is {width} x {height}, the calibration is for "
                f"{projection.picture_size[0]} x {projection.picture_size[1]}"
            )
        # Half a pixel beyond the outer centres still belongs to the picture.
        outside = (sample_pixels < -0.5) | (sample_pixels > (width - 0.5, height - 0.5))
        if outside.any():
            share = float(outside.any(axis=-1).mean())
            raise InputError(
                f"{100 * share:.1f} % of the workspace is outside of the camera's picture; choose "
                "another home pose or a smaller workspace, and calibrate anew"
            )
        big = cv2.remap(
            image, sample_pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        size = self.shape[::-1]
        return np.asarray(cv2.resize(big, size, interpolation=cv2.INTER_AREA))


@functools.lru_cache(maxsize=2)
def _samples(view: TopDownView, projection: Projection, supersample: int) -> np.ndarray:
    """Columns and rows at which a picture is sampled, (rows, columns, 2) float32.

    An episode samples all of its pictures at the same ones, and projecting them through a lens
    takes longer than the rest of looking.
    """
    rows, columns = (n * supersample for n in view.shape)
    grid = np.moveaxis(np.indices((rows, columns)), 0, -1).reshape(-1, 2)
    xy = view.pixel_to_base((grid + 0.5) / supersample - 0.5)
    sample_pixels = projection.base_to_pixel(xy).astype(np.float32).reshape(rows, columns, 2)
    sample_pixels.flags.writeable = False
    return sample_pixels
