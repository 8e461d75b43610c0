"""What the page tells of a state beside the task's score."""

from __future__ import annotations

import numpy as np

from ..tasks.metrics import mask_iou
from ..tasks.task import Task
from ..worlds.episode import RunningEpisode

__all__ = ["covered_mask", "measures", "score_meaning"]


def covered_mask(color: np.ndarray) -> np.ndarray:
    """Where a picture (H, W, 3) shows something else than its most frequent colour (H, W)."""
    packed = color.astype(np.int64) @ np.array([65536, 256, 1])
    values, counts = np.unique(packed, return_counts=True)
    return np.asarray(packed != values[counts.argmax()])


def measures(task: Task, episode: RunningEpisode) -> dict[str, float]:
    """Measures of a state by name: the task's own, and of goals how much of them is met.

    `overlap` is the intersection over union of what the picture and the goal's picture show.
    """
    told = task.measures(episode.layout, episode.snapshot)
    if episode.goal is not None:
        seen, wanted = episode.snapshot.images.color, episode.goal.color
        told = {"overlap": mask_iou(covered_mask(seen), covered_mask(wanted)), **told}
    return told


def score_meaning(task: Task) -> str:
    """What a task's score is, as the first sentence of its method says."""
    said = type(task).score.__doc__ or Task.score.__doc__ or ""
    return " ".join(said.split("\n\n")[0].split())
