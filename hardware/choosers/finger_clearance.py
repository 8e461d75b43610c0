"""Whether open fingers come down on the foam: what a mask shows beside a pick."""

from __future__ import annotations

import math

import numpy as np

from warp_deform.robots.jaw import JawConfig

from ..arm.pick_place import PickPlaceAction, PickPlaceConfig
from ..vision.top_down_view import TopDownView

__all__ = ["has_finger_clearance"]


def has_finger_clearance(
    mask: np.ndarray,
    action: PickPlaceAction,
    *,
    view: TopDownView,
    config: PickPlaceConfig | None = None,
    fingers: JawConfig | None = None,
) -> bool:
    """Return whether no part of the cable lies where a finger will touch down.

    A finger on a strand stops the descent above the foam, where closing takes hold of nothing.
    What lies between the fingers is not looked at: strands side by side are taken together.

    Args:
        mask: the cable in the view, (H, W) bool
        action: what is to be picked, and across which tangent
        view: the workspace
        config: how wide the fingers are open on the way down; default: as an episode's
        fingers: their size; default: the vendor's
    """
    fingers = fingers or JawConfig()
    inner = (config or PickPlaceConfig()).open_width_m / 2
    offsets = view.pixel_to_base(np.argwhere(mask)) - action.pick_xy
    c, s = math.cos(action.pick_yaw), math.sin(action.pick_yaw)
    along, across = np.abs(offsets @ (c, s)), np.abs(offsets @ (-s, c))
    below = (along < fingers.pad_length / 2) & (across > inner)
    return not (below & (across < inner + fingers.thickness)).any()
