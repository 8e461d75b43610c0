"""Packing a recorded episode into the dataset's format, so that policies train on it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from warp_deform.episodes import Episode, EpisodeInfo, Goal, Step, cpu_fingerprint, versions

from ..cameras.camera import read_image
from ..support.json_file import read_numbers, require
from ..vision.task_frame import to_task
from ..vision.top_down_view import TopDownView
from .recording import Recording
from .scoring import SUCCESS_IOU, score_masks, score_recording

__all__ = ["pack"]


def pack(
    folder: Path,
    *,
    seed: int,
    task: str = "cable-mask-goal",
    images: Literal["mask", "view"] = "mask",
) -> Episode:
    """Return the recording as an episode of the dataset format.

    Actions are those of the task's table at the same pixels, see `task_frame`.

    There is no simulation: particles, bodies and ground truth are empty, heights are zero, and the
    simulated time is 0. Score and success are computed from the pictures. An episode without a goal
    shows how to reach where it ended, so that is its goal (hindsight).

    Args:
        folder: the recording
        seed: number of the episode in its dataset; names the file
        task: the dataset's task, which says where its pixels are
        images: what a policy is to see: the mask in three channels, as in the paper, or colours

    Raises:
        InputError: no recording, or damaged
    """
    recording = Recording.read(folder)
    meta, what = recording.meta, f"recording {folder}"
    # A picture shows what an action did; an action after the last picture is left out.
    rows = len(recording.observations)
    view = recording.view_settings() or TopDownView()
    goal_mask = recording.goal_mask()
    hindsight = goal_mask is None
    if goal_mask is None:
        goal_mask = recording.mask(rows - 1)
        score = score_masks([recording.mask(i) for i in range(rows)], goal_mask)
    else:
        score = score_recording(folder)
    steps = []
    for i in range(rows):
        last = i == rows - 1
        mask = recording.mask(i)
        iou = score.iou[i]
        record = {} if last else recording.actions[i]
        action = None
        if not last:
            action = read_numbers(record, "action", (7,), what=f"{what}, action {i}")
            action[:2], action[3:5] = (to_task(action[k : k + 2], view) for k in (0, 3))
        outcome = None if last else require(record, "outcome", str, what=f"{what}, action {i}")
        color = _triple(mask) if images == "mask" else recording.view(i)
        empty = {"particle_q": 3, "particle_qd": 3, "body_q": 7, "body_qd": 6}
        steps.append(
            Step(
                color=color,
                height=np.zeros(mask.shape, np.float32),
                action=action,
                score=iou,
                success=iou > SUCCESS_IOU,
                physics_ok=True,
                sim_seconds=0.0,
                state_hash="",
                outcome=outcome,
                **{name: np.zeros((0, width), np.float32) for name, width in empty.items()},
                ground_truth=np.zeros(0, np.float32),
                control=None,
            )
        )
    color = _triple(goal_mask)
    if images == "view":
        end = recording.view(rows - 1)
        color = end if hindsight else read_image(folder / "goal_view.png", color=True)
    height = np.zeros(goal_mask.shape, np.float32)
    goal = Goal(color, height, np.zeros((0, 3)), kind="demonstrated", seed=seed)
    info = EpisodeInfo(
        task=task,
        seed=seed,
        success=score.success and not (hindsight and rows == 1),  # standing still shows nothing
        score=score.best[-1],
        actions=rows - 1,
        demonstrator=require(meta, "actor", str, what=what),
        robot=require(meta, "robot_id", str, what=what),
        state_hash="",
        physics_ok=True,
        sim_seconds=0.0,
        discarded_starts=0,
        config=require(meta, "config", dict, what=what),
        versions=versions(),
        cpu=cpu_fingerprint(),
        goal=None,
        extra={
            "hardware": True,
            "camera_id": require(meta, "camera_id", str, what=what),
            "calibration": require(meta, "calibration", str, what=what),
            "software": require(meta, "versions", dict, what=what),
            "outcome": meta.get("outcome"),
            "note": require(meta, "note", str, what=what),
            "images": images,
            "hindsight": hindsight,
            "times_s": [float(row["t"]) for row in recording.observations],
            "actions_after_last_picture": len(recording.actions) - (rows - 1),
            "warnings": sorted({*recording.warnings, *score.warnings, *score.differences}),
        },
    )
    return Episode(info, tuple(steps), goal)


def _triple(mask: np.ndarray) -> np.ndarray:
    return np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
