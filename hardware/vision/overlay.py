"""The planned action drawn on the workspace seen from above: what an operator confirms."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ..arm.pick_place import PickPlaceAction
from .top_down_view import TopDownView

__all__ = ["draw_action"]

_SCALE = 3
_GOAL, _CABLE, _PICK, _PLACE = (80, 170, 255), (255, 255, 255), (255, 80, 80), (90, 220, 90)
_FINGERS = 0.0175
"""Half of the fingers' opening [m]."""


def draw_action(
    seen: np.ndarray,
    view: TopDownView,
    *,
    mask: np.ndarray,
    goal: np.ndarray | None = None,
    action: PickPlaceAction | None = None,
) -> np.ndarray:
    """Return the picture `seen` (H, W, 3) uint8, three times as large, with what is planned.

    Red: where the fingers close, and the line along which they do; green: where they open. White is
    the outline of the cable's mask (H, W), blue that of the goal's.
    """
    large = (seen.shape[1] * _SCALE, seen.shape[0] * _SCALE)
    picture = np.asarray(cv2.resize(seen, large, interpolation=cv2.INTER_NEAREST))
    for area, color in ((goal, _GOAL), (mask, _CABLE)):
        if area is not None:
            wide = cv2.resize(area.astype(np.uint8), large, interpolation=cv2.INTER_NEAREST)
            outlines, _ = cv2.findContours(wide, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, outlines, -1, color, 1)
    if action is None:
        return picture
    ends = []
    for xy, yaw, color in (
        (action.pick_xy, action.pick_yaw, _PICK),
        (action.place_xy, action.place_yaw, _PLACE),
    ):
        across = _FINGERS * np.array([-math.sin(yaw), math.cos(yaw)])
        a, b, middle = (_pixel(view, np.add(xy, s * across)) for s in (-1.0, 1.0, 0.0))
        cv2.line(picture, a, b, color, 2, cv2.LINE_AA)
        cv2.circle(picture, middle, 4, color, -1, cv2.LINE_AA)
        ends.append(middle)
    cv2.arrowedLine(picture, ends[0], ends[1], _PLACE, 1, cv2.LINE_AA, tipLength=0.05)
    return picture


def _pixel(view: TopDownView, xy: np.ndarray) -> tuple[int, int]:
    """Column and row in the large picture."""
    row, column = (view.base_to_pixel(xy) + 0.5) * _SCALE
    return round(float(column)), round(float(row))
