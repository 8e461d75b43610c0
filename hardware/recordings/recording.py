"""Reading a recorded episode, also one whose recorder was killed.

A folder holds `episode.json` (what was known at the start, and the outcome), `steps.jsonl` (a line
for each observation, each action before it begins, its plan, and each finished action),
`robot.jsonl` (readings of the robot), and `frames`. A line is written only when the files it names
are on the disk, so what the lines tell is there. A killed recorder leaves at most a last line
without an end, which is left out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError

from ..cameras.camera import read_image
from ..support.json_file import read_json, read_numbers, require
from ..vision.top_down_view import TopDownView

__all__ = ["SCHEMA", "Recording"]

SCHEMA = 1
"""Version of the live folder's format."""
_MAX_LINES_BYTES = 2**30
_VIEW_KEYS = ("x", "y", "shape")


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded episode.

    Attributes:
        folder: where it is
        meta: the contents of `episode.json`
        observations: a record for each picture, in order
        actions: a record for each finished action; action i was taken on observation i
        plans: a record for each action that was begun, of recordings that have them
        robot: readings of the robot
        warnings: what is missing at the end, a line each
    """

    folder: Path
    meta: dict[str, Any]
    observations: tuple[dict[str, Any], ...]
    actions: tuple[dict[str, Any], ...]
    plans: tuple[dict[str, Any], ...]
    robot: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]

    @classmethod
    def read(cls, folder: Path) -> Recording:
        """Read a folder.

        Raises:
            InputError: no recording, of another version, or damaged otherwise than by a kill
        """
        meta = read_json(folder / "episode.json", what="recording", schema=SCHEMA)
        steps, torn = _lines(folder / "steps.jsonl")
        robot, _ = _lines(folder / "robot.jsonl")
        warnings = ["the recorder was killed while it wrote a line"] if torn else []
        if meta.get("outcome") is None:
            warnings.append("the episode was not finished: no outcome was recorded")
        observations: list[dict[str, Any]] = []
        actions: list[dict[str, Any]] = []
        plans: list[dict[str, Any]] = []
        kinds = {"observation": observations, "action": actions, "plan": plans}
        before = ""
        for number, step in enumerate(steps, start=1):
            what = f"{folder / 'steps.jsonl'}, line {number}"
            kind = str(step.get("kind"))
            rows = kinds.get(kind)
            if rows is None:
                raise InputError(f"{what}: kind {step.get('kind')!r} is unknown")
            # Observation, plan, action, observation, ...: all three belong to the first of them.
            without_action = len(observations) - len(actions)
            if kind == before or without_action != (0 if rows is observations else 1):
                raise InputError(f"{what}: two {kind}s in a row; lines are missing")
            due = len(observations if rows is observations else actions)
            if require(step, "index", int, what=what) != due:
                raise InputError(f"{what}: index {step['index']}, expected {due}")
            rows.append(step)
            before = kind
        if before == "plan":
            warnings.append(f"action {len(actions) + 1} was begun, and did not end")
        if not observations:
            raise InputError(f"{folder} was killed before its first picture; delete it")
        return cls(
            folder,
            meta,
            tuple(observations),
            tuple(actions),
            tuple(plans),
            tuple(robot),
            tuple(warnings),
        )

    def mask(self, index: int) -> np.ndarray:
        """Return the cable's mask of an observation, (H, W) bool."""
        return _mask(self.folder / "frames" / f"{index:03d}_mask.png")

    def goal_mask(self) -> np.ndarray | None:
        """Return the goal's mask, (H, W) bool; None where there is no goal."""
        if not require(self.meta, "has_goal", bool, what=f"recording {self.folder}"):
            return None
        return _mask(self.folder / "goal_mask.png")

    def view_settings(self) -> TopDownView | None:
        """Return the workspace and its pixels, None of a recording that does not tell.

        Raises:
            InputError: what is recorded is no workspace
        """
        episode = self.meta.get("config", {}).get("episode", {})
        if "view" not in episode:
            return None
        what = f"the view of recording {self.folder}"
        x, y, shape = (read_numbers(episode["view"], k, (2,), what=what) for k in _VIEW_KEYS)
        return TopDownView(
            x=(float(x[0]), float(x[1])),
            y=(float(y[0]), float(y[1])),
            shape=(int(shape[0]), int(shape[1])),
        )

    def view(self, index: int) -> np.ndarray:
        """Return an observation seen from above, (H, W, 3) uint8."""
        return read_image(self.folder / "frames" / f"{index:03d}_view.png", color=True)


def _lines(path: Path) -> tuple[list[dict[str, Any]], bool]:
    """Return the JSON objects of a file, and whether a last line without an end was left out."""
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_LINES_BYTES)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; it is no recording") from error
    whole, _, torn = data.rpartition(b"\n")
    rows = []
    for number, line in enumerate(whole.split(b"\n") if whole else [], start=1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}, line {number} is not JSON; the file is damaged") from error
        if not isinstance(row, dict):
            raise InputError(f"{path}, line {number} is no JSON object; the file is damaged")
        rows.append(row)
    return rows, bool(torn)


def _mask(path: Path) -> np.ndarray:
    levels = read_image(path, color=False)
    mask: np.ndarray = levels > 127
    return mask
