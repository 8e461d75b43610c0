"""A recorded episode gone through again: the same pictures through today's perception."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.tasks.metrics import mask_iou

from ..calibration.calibration import Calibration
from ..cameras.camera import FileCamera, read_image
from ..support.json_file import require
from ..vision.segmentation import SegmentationConfig, segment_cable
from ..vision.top_down_view import TopDownView
from .recording import Recording
from .scoring import ROUNDING, outcome_difference, score_masks

__all__ = ["Replay", "replay_recording", "write_film"]

_FILM_RATE = 2  # pictures a second


@dataclass(frozen=True, eq=False)
class Replay:
    """What came of it.

    Attributes:
        rows: a record an observation: index, recorded overlap, overlap now, whether the masks are
            the same, the action that followed, and its outcome; None where it did not end
        actions: finished actions
        mismatches: observations whose mask is another now
        differences: what was recorded and is computed otherwise, masks too, a line each
        outcome: recorded; None where the recorder was killed
        warnings: a line each
    """

    rows: tuple[dict[str, Any], ...]
    actions: int
    mismatches: int
    differences: tuple[str, ...]
    outcome: str | None
    warnings: tuple[str, ...]


def replay_recording(folder: Path) -> Replay:
    """Make the masks of a recording again, by the calibration and settings recorded with it.

    Raises:
        InputError: no recording, damaged, or one that was not made by `franka run`
    """
    recording = Recording.read(folder)
    config = require(recording.meta, "config", dict, what=f"recording {folder}")
    calibration = Calibration.load(folder / "calibration.json")
    beside = folder / "empty_view.png"
    empty = read_image(beside, color=True) if beside.is_file() else None
    settings = require(config, "episode", dict, what=f"recording {folder}")
    view, segmentation = (
        _made(TopDownView, settings, "view"),
        _made(SegmentationConfig, settings, "segmentation"),
    )
    goal = recording.goal_mask()
    camera = FileCamera(folder / "frames", calibration.intrinsics)
    planned = {plan["index"]: plan for plan in recording.plans}
    masks: list[np.ndarray] = []
    rows: list[dict[str, Any]] = []
    for index, seen in enumerate(recording.observations):
        picture = view.rectify(camera.read().rgb, calibration)
        mask = segment_cable(picture, config=segmentation, empty=empty)
        masks.append(mask)
        done = recording.actions[index] if index < len(recording.actions) else {}
        begun = done or planned.get(index, {})
        rows.append(
            {
                "index": index,
                "iou": seen.get("iou"),
                "iou_now": None if goal is None else mask_iou(mask, goal),
                "same_mask": bool(np.array_equal(mask, recording.mask(index))),
                "outcome": done.get("outcome"),
                "action": begun.get("action"),
            }
        )
    return Replay(
        tuple(rows),
        len(recording.actions),
        sum(not row["same_mask"] for row in rows),
        (*_differences(rows), *_of_the_whole(recording, calibration, masks, goal)),
        recording.meta.get("outcome"),
        recording.warnings,
    )


def _differences(rows: list[dict[str, Any]]) -> Iterator[str]:
    for row in rows:
        recorded, now = row["iou"], row["iou_now"]
        if not row["same_mask"]:
            yield f"picture {row['index']}: its mask is another now"
        if (recorded is None) != (now is None):
            yield f"picture {row['index']}: recorded overlap {recorded}, now {now}"
        elif recorded is not None and not abs(recorded - now) <= ROUNDING:
            yield f"picture {row['index']}: recorded overlap {recorded:.4f}, now {now:.4f}"


def _of_the_whole(
    recording: Recording, calibration: Calibration, masks: list[np.ndarray], goal: np.ndarray | None
) -> Iterator[str]:
    digest = require(recording.meta, "calibration", str, what=f"recording {recording.folder}")
    if calibration.digest() != digest:
        yield "calibration.json is another than the one it was recorded with"
    if goal is not None:
        yield from outcome_difference(recording.meta.get("outcome"), score_masks(masks, goal))


def _made(kind: type, settings: dict[str, Any], name: str) -> Any:
    """A configuration from its record."""
    record = require(settings, name, dict, what="the recording's settings")
    known = {field.name for field in fields(kind)}
    if set(record) != known:
        raise InputError(f"the recording's {name} has other settings than this release's; {known}")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in record.items()})


def write_film(folder: Path, path: Path) -> None:
    """Write the plans of an episode as a film.

    Raises:
        InputError: no recording, or the file cannot be written
    """
    from warp_deform.rendering.video import VideoWriter

    with VideoWriter(path, _FILM_RATE) as film:
        for index in range(len(Recording.read(folder).observations)):
            picture = folder / "frames" / f"{index:03d}_overlay.png"
            film.write(read_image(picture, color=True))
