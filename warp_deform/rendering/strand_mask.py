"""Binary masks of a chain seen from straight above, clean or as cameras and segmentation give them.

A pixel belongs to the mask when the chain covers half of it or more. Where a look is given, the
picture is a little turned, scaled and shifted, as by an imperfect calibration, the chain thicker or
thinner, its outline ragged, and pieces of it are missing.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np

from .pixels import SHAPE, PixelGrid

__all__ = ["MaskLook", "draw_line", "strand_mask"]

_SAMPLES = 8  # a pixel and side
_BITS = 4  # of a pixel, for OpenCV's drawing


@dataclass(frozen=True, kw_only=True)
class MaskLook:
    """How a mask departs from the truth in one episode; the defaults change nothing."""

    width: float = 1.0
    """Factor on the chain's width: above 1 dilated, below 1 eroded."""
    scale: float = 1.0
    """Factor on distances from the picture's middle."""
    tilt: float = 0.0
    """Turn about the picture's middle [rad]."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Of rows and columns [px]."""
    ragged: float = 0.0
    """Standard deviation of the threshold along the outline, as a share of a pixel."""
    holes: float = 0.0
    """Expected number of gaps in the chain."""
    hole_px: float = 2.5
    """Largest radius of a gap [px]."""
    seed: int = 0
    """Of outline and gaps; they differ from state to state."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> MaskLook:
        """A look for one episode."""
        return cls(
            width=float(rng.uniform(0.85, 1.4)),
            scale=float(rng.normal(1.0, 0.004)),
            tilt=float(rng.normal(0.0, 0.004)),
            shift=(float(rng.normal(0.0, 0.3)), float(rng.normal(0.0, 0.3))),
            ragged=float(rng.uniform(0.0, 0.12)),
            holes=float(rng.uniform(0.0, 1.5)),
            seed=int(rng.integers(2**31)),
        )


def strand_mask(
    points: np.ndarray, width: float, grid: PixelGrid, *, look: MaskLook | None = None
) -> np.ndarray:
    """Mask (320, 160) bool of a strand through `points` (n, 2) [m] that is `width` [m] wide."""
    pixels = grid.fractional(points)
    thickness = width / grid.pixel_size
    if look is not None:
        thickness *= look.width
        c, s = look.scale * np.cos(look.tilt), look.scale * np.sin(look.tilt)
        middle = (np.array(SHAPE) - 1) / 2
        pixels = (pixels - middle) @ np.array([[c, s], [-s, c]]) + middle + look.shift
    covered = _coverage(pixels, thickness)
    if look is None:
        return covered >= 0.5
    exact = np.ascontiguousarray(points, dtype=np.float32).tobytes()
    rng = np.random.default_rng([look.seed, zlib.crc32(exact)])
    noise = rng.normal(0.0, 1.0, SHAPE).astype(np.float32)
    covered = covered + look.ragged * noise * (covered > 0)
    for _ in range(rng.poisson(look.holes)):
        row, column = pixels[rng.integers(len(pixels))]
        rows, columns = np.ogrid[: SHAPE[0], : SHAPE[1]]
        radius = rng.uniform(0.8, look.hole_px)
        covered[(rows - row) ** 2 + (columns - column) ** 2 < radius**2] = 0.0
    return np.asarray(covered >= 0.5)


def _coverage(pixels: np.ndarray, thickness: float) -> np.ndarray:
    """How much of every pixel (320, 160) a line through `pixels` (n, 2), row and column, covers."""
    covered = np.zeros(SHAPE, np.float32)
    reach = thickness / 2 + 2
    low = np.clip(np.floor(pixels.min(axis=0) - reach).astype(int), 0, SHAPE)
    high = np.clip(np.ceil(pixels.max(axis=0) + reach).astype(int), 0, SHAPE)
    size = high - low
    if not size.all():
        return covered
    large = np.zeros(size * _SAMPLES, np.uint8)
    draw_line(large, (pixels - low + 0.5)[:, ::-1] * _SAMPLES - 0.5, thickness * _SAMPLES)
    fine = cv2.resize(large, tuple(size[::-1].tolist()), interpolation=cv2.INTER_AREA)
    covered[low[0] : high[0], low[1] : high[1]] = fine.astype(np.float32) / 255.0
    return covered


def draw_line(image: np.ndarray, points: np.ndarray, thickness: float) -> None:
    """Draw a line of 255 through `points` (n, 2), column and row, `thickness` [px] wide.

    It is at most half a pixel thicker or thinner: OpenCV draws an even thickness t as t + 1 and an
    odd one as t + 2 (measured; version 4).
    """
    fine = np.rint(points * 2**_BITS).astype(np.int32).reshape(-1, 1, 2)
    even = 2 * max(1, round((thickness - 1) / 2))
    cv2.polylines(image, [fine], False, 255, even, cv2.LINE_8, _BITS)
