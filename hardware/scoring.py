"""How well an episode went: the overlap of the cable's mask with the goal's, as in simulation.

Source: Seita et al., ICRA 2021, section on physical experiments: an episode succeeds when the
intersection over union exceeds 0.25 at any time within 10 actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_deform.errors import InputError
from warp_deform.tasks.metrics import mask_iou

from .recording import Recording

__all__ = ["MAX_ACTIONS", "SUCCESS_IOU", "EpisodeScore", "score_masks", "score_recording"]

SUCCESS_IOU = 0.25
"""Overlap above which an episode succeeds."""
MAX_ACTIONS = 10
"""Actions that an episode may take."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class EpisodeScore:
    """An episode's score.

    Attributes:
        iou: overlap before the first action and after each
        best: best overlap so far, for each of them
        success: whether it exceeded `SUCCESS_IOU` within `MAX_ACTIONS` actions
        actions_to_success: how many actions that took; None without success
        warnings: what makes the score doubtful, a line each
    """

    iou: tuple[float, ...]
    best: tuple[float, ...]
    success: bool
    actions_to_success: int | None
    warnings: tuple[str, ...]


def score_masks(masks: Sequence[np.ndarray], goal: np.ndarray) -> EpisodeScore:
    """Return the score of masks (H, W), the first before any action, against the goal's (H, W).

    Raises:
        InputError: no masks, or of another size than the goal's
    """
    if not len(masks):
        raise InputError("an episode without a picture has no score")
    warnings = []
    for i, mask in enumerate(masks):
        if mask.shape != goal.shape:
            raise InputError(
                f"mask {i} has shape {mask.shape}, the goal {goal.shape}; use one view for both"
            )
        if not mask.any():
            warnings.append(f"mask {i} is empty: it scores 0")
    if not np.any(goal):
        warnings.append("the goal's mask is empty: everything scores 0")
    iou = tuple(mask_iou(mask, goal) for mask in masks)
    best = tuple(np.maximum.accumulate(iou).tolist())
    reached = [i for i, value in enumerate(iou[: MAX_ACTIONS + 1]) if value > SUCCESS_IOU]
    return EpisodeScore(iou, best, bool(reached), reached[0] if reached else None, tuple(warnings))


def score_recording(folder: Path) -> EpisodeScore:
    """Return the score of a recorded episode, computed anew from its pictures.

    A recorded overlap that disagrees with the pictures is a warning, not a score; so is a dry run.

    Raises:
        InputError: no recording, one without a goal, or damaged
    """
    recording = Recording.read(folder)
    goal = recording.goal_mask()
    if goal is None:
        raise InputError(f"{folder} was recorded without a goal; there is nothing to score")
    still: tuple[str, ...] = ()
    if recording.meta.get("config", {}).get("executed") is False:
        still = ("a dry run: nothing moved, so its score says nothing of its actions",)
    masks = [recording.mask(i) for i in range(len(recording.observations))]
    score = score_masks(masks, goal)
    disagree = tuple(
        f"picture {i}: recorded {recorded:.4f}, its files give {computed:.4f}"
        for i, computed in enumerate(score.iou)
        if (recorded := recording.observations[i]["iou"]) is not None
        and abs(recorded - computed) > _ROUNDING
    )
    return EpisodeScore(
        score.iou,
        score.best,
        score.success,
        score.actions_to_success,
        (*score.warnings, *still, *recording.warnings, *disagree),
    )
