"""Which pixels are the cable: those that differ from the foam around them.

The foam's colour is taken from a picture of the empty table, or else from the picture itself: a
median over a window much wider than the cable, which follows light that falls off over the table.
The threshold lies half-way between foam and cable, so an edge pixel counts when the cable covers
half of it and the mask is as wide as the cable.

Source of the colour distance: CIE 1976 L*a*b*.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from warp_deform.errors import InputError, WarpDeformError

__all__ = ["SegmentationConfig", "SegmentationError", "segment_cable"]


class SegmentationError(WarpDeformError):
    """The picture does not show a cable on foam; the message says what to do."""


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig:
    """What counts as cable."""

    min_contrast: float = 15.0
    """Least colour difference from the foam; 2.3 is just noticeable, black and white are 100."""
    polarity: Literal["any", "darker", "brighter"] = "any"
    """Whether the cable is darker or brighter than the foam, or just another colour; a known
    polarity leaves out shadows beside a bright cable."""
    window_px: int = 41
    """Side of the window for the foam's median; more than ten times the cable's width."""
    close_px: int = 3
    """Gaps up to about this width are closed: links between beads."""
    min_area_px: int = 40
    """Smaller patches are specks."""
    max_share: float = 0.25
    """Greatest share of the region that may be cable: more is a wrong threshold or light."""

    def __post_init__(self) -> None:
        if not 1.0 <= self.min_contrast <= 100.0 or self.polarity not in _SIGNS:
            raise InputError(
                f"segmentation: min_contrast 1 to 100 and polarity {tuple(_SIGNS)}, not "
                f"{self.min_contrast} and {self.polarity!r}"
            )
        if not (3 <= self.window_px <= 255 and self.window_px % 2 and 1 <= self.close_px <= 15):
            raise InputError("segmentation: window_px odd, 3 to 255, and close_px 1 to 15")
        if self.min_area_px < 1 or not 0.0 < self.max_share <= 1.0:
            raise InputError("segmentation: min_area_px 1 or more, max_share above 0, at most 1")


_SIGNS = {"any": 0.0, "darker": -1.0, "brighter": 1.0}


def segment_cable(
    rgb: np.ndarray,
    *,
    config: SegmentationConfig | None = None,
    empty: np.ndarray | None = None,
    region: np.ndarray | None = None,
) -> np.ndarray:
    """Return the cable's mask (H, W) bool of a picture (H, W, 3) uint8; it may be empty.

    Args:
        rgb: the picture
        config: what counts as cable
        empty: the same view without the cable, (H, W, 3) uint8; better than the median where the
            foam has marks or edges
        region: (H, W) bool, where to look; default everywhere

    Raises:
        SegmentationError: more than `max_share` of the region differs from its surroundings
        InputError: wrong shapes
    """
    config = config or SegmentationConfig()
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(f"a picture is (H, W, 3) uint8, not {rgb.shape} {rgb.dtype}")
    region = np.ones(rgb.shape[:2], dtype=bool) if region is None else region.astype(bool)
    if region.shape != rgb.shape[:2] or (empty is not None and empty.shape != rgb.shape):
        raise InputError("the region and the empty picture need the picture's size")
    if not region.any():
        raise InputError("the region to look in is empty")
    foam = _foam(rgb, region, config.window_px) if empty is None else empty
    difference = _lab(rgb) - _lab(foam)
    contrast = np.linalg.norm(difference, axis=2)
    if _SIGNS[config.polarity]:
        contrast = np.where(_SIGNS[config.polarity] * difference[..., 0] > 0.0, contrast, 0.0)
    contrast[~region] = 0.0
    strong = contrast > config.min_contrast
    if strong.any():
        # The cable's own contrast is that of its better covered half of pixels.
        half = 0.5 * float(np.percentile(contrast[strong], 75))
        strong = contrast > max(config.min_contrast, half)
    mask = _clean(strong, config) & region
    share = np.count_nonzero(mask) / np.count_nonzero(region)
    if share > config.max_share:
        raise SegmentationError(
            f"{100 * share:.0f} % of the workspace differs from the foam, at most "
            f"{100 * config.max_share:.0f} % can be cable; even out the light, clear the table, or "
            "raise min_contrast"
        )
    return mask


def _foam(rgb: np.ndarray, region: np.ndarray, window: int) -> np.ndarray:
    """Return the picture without what is narrower than half of the window."""
    filled = rgb.copy()
    # What is beyond the foam must not enter the medians near its rim.
    filled[~region] = np.median(rgb[region], axis=0).astype(np.uint8)
    half = window // 2
    bordered = cv2.copyMakeBorder(filled, half, half, half, half, cv2.BORDER_REFLECT_101)
    inner = slice(half, -half)
    return np.asarray(cv2.medianBlur(bordered, window)[inner, inner])


def _lab(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB))


def _clean(mask: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """Close gaps and leave out specks."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (config.close_px, config.close_px))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    _, labels, figures, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    large_enough = figures[:, cv2.CC_STAT_AREA] >= config.min_area_px
    large_enough[0] = False  # the background
    cleaned: np.ndarray = large_enough[labels]
    return cleaned
