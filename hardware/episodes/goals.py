"""Goals: masks to reach, from files or drawn as the simulated task draws them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from warp_deform.errors import InputError
from warp_deform.rendering.strand_mask import strand_mask
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import curved_chain
from warp_deform.tasks.strand_trace import trace_strand

from ..cameras.camera import read_image
from ..support.json_file import write_whole
from ..vision.top_down_view import TopDownView

__all__ = ["GoalMask", "read_goal", "sampled_goal", "write_goal", "write_picture"]

_GOAL_STREAM = 1


@dataclass(frozen=True, eq=False)
class GoalMask:
    """A mask to reach.

    Attributes:
        mask: (320, 160) bool
        targets: where the chain's beads lie in it [m], (n, 2), for those who need to know
    """

    mask: np.ndarray
    targets: np.ndarray | None


def sampled_goal(seed: int, view: TopDownView | None = None) -> GoalMask:
    """Return a goal as the simulated task draws it: a smooth curve in the workspace."""
    rng, task = np.random.default_rng([seed, _GOAL_STREAM]), CableMaskGoal
    view = view or TopDownView()
    bend = rng.uniform(*task.goal_bend)
    beads = curved_chain(rng, task.cable, view.x, view.y, bend=bend)
    mask = strand_mask(beads[:, :2], 2 * task.cable.visual_radius, view.grid)
    return GoalMask(mask, beads[:, :2])


def read_goal(path: Path, view: TopDownView) -> GoalMask:
    """Return the goal that `capture-goal` wrote.

    Raises:
        InputError: missing, of another size, or empty
    """
    mask = read_image(path, color=True)[..., 1] > 127
    if mask.shape != view.shape or not mask.any():
        raise InputError(
            f"the goal {path} has {mask.shape} pixels, {np.count_nonzero(mask)} of cable; needed "
            f"is a mask of {view.shape}: capture it with `warp-deform franka capture-goal`"
        )
    traced = trace_strand(mask, CableMaskGoal.cable.beads)
    return GoalMask(mask, None if traced is None else view.pixel_to_base(traced))


def write_goal(path: Path, mask: np.ndarray, view: np.ndarray) -> Path:
    """Write a mask (H, W) bool, and beside it the view (H, W, 3); returns the view's path.

    Raises:
        InputError: no PNG's name, or it cannot be written
    """
    if path.suffix != ".png":
        raise InputError(f"a goal is a .png, not {path}")
    beside = path.with_name(f"{path.stem}_view.png")
    levels = np.where(mask, 255, 0).astype(np.uint8)
    write_picture(path, np.repeat(levels[..., None], 3, axis=2))
    write_picture(beside, view)
    return beside


def write_picture(path: Path, rgb: np.ndarray) -> None:
    """Write a picture (H, W, 3) uint8 as PNG, whole or not at all.

    Raises:
        InputError: it cannot be written
    """
    write_whole(path, cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
