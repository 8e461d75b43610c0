"""The table's surface in the base frame: a plane, measured by touching it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_deform.errors import InputError

from .arguments import real_number

__all__ = ["MAX_SLOPE", "TablePlane", "fit_table_plane"]

MAX_SLOPE = 0.05
"""Steepest table that is believed, 3 degrees: more is a wrong touch or a badly mounted robot."""
_MAX_RESIDUAL = 2e-3  # [m]
_MIN_POINTS = 4  # three always fit a plane, and say nothing about how well
_MIN_SPREAD = 0.05  # [m], across the narrow side of the points


@dataclass(frozen=True)
class TablePlane:
    """Height of the table: z = height_m + slope_x x + slope_y y.

    Attributes:
        height_m: at the origin of the base [m], which is where the robot stands, not the workspace
        slope_x: rise along x
        slope_y: rise along y
    """

    height_m: float
    slope_x: float = 0.0
    slope_y: float = 0.0

    def __post_init__(self) -> None:
        for name in ("height_m", "slope_x", "slope_y"):
            real_number(f"the table's {name}", getattr(self, name))
        values = (self.height_m, self.slope_x, self.slope_y)
        if not all(math.isfinite(value) for value in values):
            raise InputError(f"the table's plane {values} is not finite; touch it off again")
        if max(abs(self.slope_x), abs(self.slope_y)) > MAX_SLOPE:
            raise InputError(
                f"the table's slopes {self.slope_x:.3f}, {self.slope_y:.3f} exceed {MAX_SLOPE}; "
                "touch it off again"
            )

    def z(self, xy: np.ndarray) -> np.ndarray:
        """Return the height [m] (...) under points x, y [m] (..., 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        height: np.ndarray = self.height_m + self.slope_x * xy[..., 0] + self.slope_y * xy[..., 1]
        return height


def fit_table_plane(points: np.ndarray) -> tuple[TablePlane, np.ndarray]:
    """Return the plane through touched points (n, 3) [m] by least squares, and the residuals (n,).

    Raises:
        InputError: fewer than four points, points on a line, one more than 2 mm off, or a table
            steeper than `MAX_SLOPE`
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < _MIN_POINTS:
        raise InputError(
            f"the table needs {_MIN_POINTS} or more touched points (n, 3), not {points.shape}"
        )
    if not np.isfinite(points).all():
        raise InputError("a touched point is not finite; touch it again")
    centre = points.mean(axis=0)
    centred = points - centre
    narrow = np.linalg.svd(centred[:, :2], compute_uv=False)[1] / math.sqrt(len(points))
    if narrow < _MIN_SPREAD / 2:
        raise InputError(
            f"the touched points lie within {2e3 * narrow:.0f} mm of a line; "
            "touch the four corners of the workspace"
        )
    slope = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0]
    residuals = centred[:, 2] - centred[:, :2] @ slope
    worst = int(np.argmax(np.abs(residuals)))
    if abs(residuals[worst]) > _MAX_RESIDUAL:
        raise InputError(
            f"touched point {worst + 1} is {1e3 * residuals[worst]:+.1f} mm off the plane of all "
            f"(allowed: {1e3 * _MAX_RESIDUAL:.0f} mm); touch it again"
        )
    plane = TablePlane(float(centre[2] - centre[:2] @ slope), float(slope[0]), float(slope[1]))
    return plane, residuals
