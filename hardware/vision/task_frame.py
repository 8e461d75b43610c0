"""Between a workspace and the table of the simulated task, by pixels: what policies learn and say.

A policy sees pixels, and those of `cable-mask-goal` stand for one table. A workspace elsewhere, or
a little larger, shows the same picture of another part of the world: a point's pixel is what both
have in common.
"""

from __future__ import annotations

import numpy as np

from warp_deform.tasks.cable_mask_goal import CableMaskGoal

from .top_down_view import TopDownView

__all__ = ["PIXEL_RATIO", "fits_task", "to_base", "to_task"]

PIXEL_RATIO = 0.1
"""Share by which a workspace's pixels may differ in size from the task's: the paper's workspace has
7 % larger ones, and the task's masks are scaled at random."""


def fits_task(view: TopDownView) -> bool:
    """Whether a policy of the task may act in a workspace: pixels alike in number and size."""
    grid = CableMaskGoal.grid
    corner = grid.to_pixel(np.array([CableMaskGoal.x[1], CableMaskGoal.y[1]]) - grid.pixel_size / 2)
    same_number = tuple((corner + 1).tolist()) == view.shape
    return same_number and abs(view.pixel_m / grid.pixel_size - 1.0) <= PIXEL_RATIO


def to_base(xy: np.ndarray, view: TopDownView) -> np.ndarray:
    """Return base x, y [m] of the task's points (..., 2) [m]."""
    return view.pixel_to_base(CableMaskGoal.grid.fractional(xy))


def to_task(xy: np.ndarray, view: TopDownView) -> np.ndarray:
    """Return the task's x, y [m] of points in the base frame (..., 2) [m]."""
    return CableMaskGoal.grid.to_world(view.base_to_pixel(xy))
