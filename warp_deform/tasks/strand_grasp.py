"""How to take a cable: its tangent where it is to be picked, from a mask.

The fingers travel across the cable, so the hand turns to its tangent. The tangent is the main axis
of the mask's pixels about the pick, weighted by a Gaussian, corrected by the slope of a parabola
fitted along that axis: at the end of a cable, or off its middle line, the pixels are not symmetric
and the axis alone leans towards the bend. Where strands cross or touch no single tangent exists;
such places are found by what the mask does on circles about the pick, and by its width.

Source: Seita et al., ICRA 2021, section on physical experiments (best-fit tangent of a mask crop
about the pick, fingers perpendicular to it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ..errors import InputError

__all__ = ["Grasp", "GraspConfig", "find_strand_grasp", "map_direction", "wrap_half_turn"]

_SIGMA = 0.5  # of the Gaussian, relative to the crop's radius
_REFINEMENTS = 3
_SHORT = 4.0  # [px] of strand along the tangent: less shows no bend
_PLACES = 40  # at which the mask's typical width is measured
# Where along the tangent the width is measured, relative to the radius.
_BANDS = ((-0.75, -0.45), (-0.25, 0.25), (0.45, 0.75))


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """How much of the mask counts, in pixels of a picture with 1.9 mm pixels."""

    radius_px: float = 10.0
    """Radius of the crop about the pick; the paper's crop is 20 x 20 pixels."""
    small_radius_px: float = 6.0
    """Radius of the second attempt where the first finds a crossing."""
    snap_px: float = 8.0
    """How far from the cable a pick may be; it moves to the nearest pixel of the mask."""
    max_spread: float = 0.5
    """Greatest ratio of the minor to the main variance: above it the crop shows a blob."""
    max_width_ratio: float = 1.3
    """Greatest width relative to the whole mask's: above it two strands lie side by side. Lone
    strands, drawn with bends down to 3 cm, had at most 1.26."""
    small_max_width_ratio: float = 1.12
    """The same for the second attempt, which sees less and so has to see it more clearly."""


@dataclass(frozen=True)
class Grasp:
    """Where and how to take the cable.

    Attributes:
        point: row and column on the cable's middle line beside the pick, not rounded [px]
        tangent: angle of the cable from the column axis towards the row axis [rad], within
            (-pi/2, pi/2]: its direction in the picture is (cos along columns, sin along rows)
        opening: angle along which the fingers open, perpendicular to the tangent [rad], wrapped
        spread: minor over main variance; 0 for a line, 1 for a disc
        width_ratio: width here relative to the mask's typical width
        crossing: whether strands meet here: the tangent is not to be trusted
    """

    point: tuple[float, float]
    tangent: float
    opening: float
    spread: float
    width_ratio: float
    crossing: bool


def wrap_half_turn(angle: float) -> float:
    """The same line within (-pi/2, pi/2] [rad]: a parallel jaw looks the same turned by pi.

    Examples:
        >>> round(wrap_half_turn(0.6 * math.pi) / math.pi, 6)
        -0.4
    """
    wrapped = math.remainder(angle, math.pi)
    return math.pi / 2 if wrapped <= -math.pi / 2 else wrapped


def find_strand_grasp(
    mask: np.ndarray, pick: tuple[float, float], *, config: GraspConfig | None = None
) -> Grasp | None:
    """Return how to take the cable of `mask` (H, W) near row and column `pick`.

    None where no pixel of the mask is within `snap_px`.

    Raises:
        InputError: no mask of two dimensions, or a pick outside of it
    """
    config = config or GraspConfig()
    if mask.ndim != 2:
        raise InputError(f"a mask has two dimensions, not shape {mask.shape}")
    mask = mask.astype(bool)
    row, column = pick
    if not (0 <= row <= mask.shape[0] - 1 and 0 <= column <= mask.shape[1] - 1):
        raise InputError(f"the pick ({row}, {column}) is outside of the mask {mask.shape}")
    pixels = np.argwhere(mask)
    if not len(pixels):
        return None
    squares = ((pixels - (row, column)) ** 2).sum(axis=1)
    nearest = pixels[int(np.argmin(squares))]
    if squares.min() > config.snap_px**2:
        return None
    at = int(nearest[0]), int(nearest[1])
    typical = _typical_width(mask, pixels, config.radius_px)
    grasp = _measure(mask, at, config.radius_px, typical, config.max_width_ratio, config)
    if grasp.crossing:
        limit = config.small_max_width_ratio
        closer = _measure(mask, at, config.small_radius_px, typical, limit, config)
        grasp = grasp if closer.crossing else closer
    return grasp


def map_direction(tangent: float, jacobian: np.ndarray) -> float:
    """Return the tangent in the base frame [rad], within (-pi/2, pi/2].

    Args:
        tangent: in the picture, see `Grasp` [rad]
        jacobian: (2, 2), change of base x, y with column and row: pictures may be mirrored or
            sheared, so angles are not simply added
    """
    x, y = np.asarray(jacobian, dtype=float) @ (math.cos(tangent), math.sin(tangent))
    return wrap_half_turn(math.atan2(y, x))


def _measure(
    mask: np.ndarray,
    at: tuple[int, int],
    radius: float,
    typical: float,
    max_ratio: float,
    config: GraspConfig,
) -> Grasp:
    strand = _strand(mask, at, radius)
    offsets, angle, foot, spread = _fit(strand, radius)
    c, s = math.cos(angle), math.sin(angle)
    along, across = offsets @ (c, s), offsets @ (-s, c)
    widths = [_width(along, across, low * radius, high * radius) for low, high in _BANDS]
    ratio = max(widths) / typical
    return Grasp(
        point=(at[0] + foot * c, at[1] - foot * s),
        tangent=wrap_half_turn(angle),
        opening=wrap_half_turn(angle + math.pi / 2),
        spread=spread,
        width_ratio=ratio,
        # Far from the pick, a lone strand is one arc of the circle on either side.
        crossing=bool(spread > config.max_spread or _arcs(strand, radius) > 2 or ratio > max_ratio),
    )


def _fit(strand: np.ndarray, radius: float) -> tuple[np.ndarray, float, float, float]:
    """Fit the strand of a crop.

    Returns:
        its pixels as column and row from the pick, (n, 2); the tangent's angle [rad]; the distance
        of the middle line from the pick, across the tangent; minor over main variance
    """
    offsets = np.argwhere(strand)[:, ::-1] - (int(radius), int(radius))
    distance = np.hypot(*offsets.T)
    offsets, distance = offsets[distance <= radius], distance[distance <= radius]
    weights = np.exp(-0.5 * (distance / (_SIGMA * radius)) ** 2)
    centred = offsets - weights @ offsets / weights.sum()
    variances, axes = np.linalg.eigh((weights[:, None] * centred).T @ centred / weights.sum())
    spread = float(variances[0] / variances[1]) if variances[1] > 0.0 else 1.0
    angle, foot = math.atan2(axes[1, 1], axes[0, 1]), 0.0
    for _ in range(_REFINEMENTS):
        c, s = math.cos(angle), math.sin(angle)
        along, across = offsets @ (c, s), offsets @ (-s, c)
        if np.ptp(along) < _SHORT:
            break
        basis = np.stack([np.ones_like(along), along, along**2], axis=1) * weights[:, None] ** 0.5
        fit = np.linalg.lstsq(basis, across * weights**0.5, rcond=None)[0]
        angle += math.atan(float(fit[1]))
        foot = float(fit[0])
    return offsets, angle, foot, spread


def _strand(mask: np.ndarray, at: tuple[int, int], radius: float) -> np.ndarray:
    """Return the part of the crop about `at` that hangs together with it, bool (2r+1, 2r+1)."""
    r = int(radius)
    padded = np.pad(mask, r)
    crop = padded[at[0] : at[0] + 2 * r + 1, at[1] : at[1] + 2 * r + 1]
    _, labels = cv2.connectedComponents(crop.astype(np.uint8), connectivity=8)
    strand: np.ndarray = labels == labels[r, r]
    return strand


def _arcs(strand: np.ndarray, radius: float) -> int:
    """Return how many pieces of a circle of 0.85 `radius` about the pick the strand covers."""
    r = int(radius)
    turns = np.linspace(0.0, 2.0 * math.pi, int(16 * radius), endpoint=False)
    rows = np.rint(r + 0.85 * radius * np.sin(turns)).astype(int)
    columns = np.rint(r + 0.85 * radius * np.cos(turns)).astype(int)
    covered = strand[rows, columns]
    return int(np.count_nonzero(covered & ~np.roll(covered, 1)))


def _width(along: np.ndarray, across: np.ndarray, low: float, high: float) -> float:
    """Return the strand's width [px] in a band across it: its pixels per length."""
    part = (along > low) & (along <= high)
    if np.count_nonzero(part) < 3:
        return 0.0
    slope = float(np.polyfit(along[part], across[part], 1)[0])
    return float(np.count_nonzero(part) / (high - low) / math.hypot(1.0, slope))


def _typical_width(mask: np.ndarray, pixels: np.ndarray, radius: float) -> float:
    """Return the mask's typical width [px]: the median over places spread evenly over it."""
    widths = []
    for row, column in pixels[:: max(len(pixels) // _PLACES, 1)]:
        offsets, angle, _, _ = _fit(_strand(mask, (int(row), int(column)), radius), radius)
        c, s = math.cos(angle), math.sin(angle)
        widths.append(_width(offsets @ (c, s), offsets @ (-s, c), -0.25 * radius, 0.25 * radius))
    return max(float(np.median(widths)), 1.0)
