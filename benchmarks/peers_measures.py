"""What is measured of a play: its error against the engine's own fine solution, and its faults.

Errors are root mean squares over particles or bodies, medians over starts. Where a scene becomes
chaotic only its first tenths of a second have an error; what follows is compared by statistics.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures import bag_scenes
from fixtures.cloth_scenes import edges_of

from warp_deform.peers import PeerScene, SoftScene

__all__ = ["EARLY", "believable", "measure_play"]

FRAME_RATE = 60
EARLY = {
    "cable": 0.1,
    "heap": 4 / 60,
    "ring": 0.1,
    "block": 0.15,
    "tower": 0.2,
    "fold10": 1.0,
    "fold25": 1.0,
    "crumple10": 0.1,
    "crumple25": 0.1,
    "shell-cube": 0.15,
}
"""When the error is read [s]: after the first contacts; a fold's when its flap has turned by 140
degrees, before it lies down."""

LIMITS = {
    "links": {"stretch_end": 1.02, "stretch": 1.1, "height_mm": 0.2, "speed": 0.2},
    "block": {"height_mm": 0.2, "speed": 0.05},
    "tower": {"height_mm": 1.0, "speed": 0.05},
    "soft": {"stretch_end": 1.1, "pierced_percent": 3.0, "below_mm": 1.0, "speed": 0.3},
}
"""What a believable end of a play does not exceed."""
_KINDS = dict.fromkeys(("cable", "heap", "ring"), "links") | {"block": "block", "tower": "tower"}
OVERLAP_MM = 1.0
"""Of two beads that lie on each other. Point masses of Newton never touch, which is said of them
instead."""


def measure_play(
    starts: list[PeerScene] | list[SoftScene], tracks: np.ndarray, fine: np.ndarray | None
) -> dict[str, Any]:
    """Errors and faults of `tracks` (starts, frames, n, 3) [m] against those of `fine`.

    A play that is not finite has no other entry than `finite`.
    """
    if not np.isfinite(tracks).all() or np.abs(tracks).max() > 10:
        return {"finite": False}
    first = starts[0]
    values: dict[str, Any] = {"finite": True}
    if fine is not None:
        at = round(EARLY[first.name] * FRAME_RATE) - 1
        apart = 1e3 * np.sqrt((np.square(tracks - fine[: len(tracks)]).sum(axis=3)).mean(axis=2))
        middle = np.median(apart, axis=0)
        values |= {"early_mm": float(middle[at]), "end_mm": float(middle[-1])}
        # by frames, so that another time can be looked at without playing again
        values["frames_mm"] = [round(float(each), 4) for each in middle[: 2 * at + 2]]
    ends = tracks[:, -1]
    values["speed"] = float(np.linalg.norm(ends - tracks[:, -4], axis=2).max() * FRAME_RATE / 3)
    values["hull_cm2"] = float(np.mean([_hull(end) for end in ends])) if ends.shape[1] > 3 else 0.0
    seen = list(zip(starts, tracks, strict=True))
    if isinstance(first, PeerScene) and first.cable is None:
        values["height_mm"] = float(1e3 * np.abs(ends[:, :, 2] - first.rest_heights).max())
        return values
    values["stretch"] = max(start.stretch(frame) for start, track in seen for frame in track)
    values["stretch_end"] = max(start.stretch(track[-1]) for start, track in seen)
    if isinstance(first, PeerScene):
        lowest = ends[:, :, 2].min(axis=1) - first.cable.radius
        values["height_mm"] = float(1e3 * np.abs(lowest).max())
        values["overlap_mm"] = float(1e3 * max(_overlap(first, end) for end in ends))
    else:
        values["below_mm"] = float(max(0.0, -1e3 * ends[:, :, 2].min()))
        share = [pierced(end, first.triangles) for end in ends]
        values["pierced_percent"] = float(100 * np.mean(share))
    return values


def believable(row: dict[str, Any]) -> bool:
    """Whether nothing of a row is beyond `LIMITS`."""
    errors = row["errors"]
    if not errors["finite"]:
        return False
    scene = row["scene"]
    kind = _KINDS.get(scene, "soft")
    touching = row["settings"].get("beads") != "particles"
    if touching and errors.get("overlap_mm", 0.0) > OVERLAP_MM:
        return False
    return all(errors[name] <= limit for name, limit in LIMITS[kind].items())


def pierced(x: np.ndarray, faces: np.ndarray) -> float:
    """Share of the edges that pierce a triangle with which they share no corner."""
    return bag_scenes.pierced(x, faces) / len(edges_of(faces))


def _hull(points: np.ndarray) -> float:
    """Area covered from above [cm^2]."""
    return float(1e4 * ConvexHull(points[:, :2]).volume)


def _overlap(scene: PeerScene, beads: np.ndarray) -> float:
    """How deep two beads that are no neighbours lie in each other [m]."""
    assert scene.cable is not None
    count = len(beads)
    apart = np.linalg.norm(beads[:, None] - beads, axis=2)
    steps = np.abs(np.arange(count)[:, None] - np.arange(count))
    if scene.cable.closed:
        steps = np.minimum(steps, count - steps)
    return float(max(0.0, 2 * scene.cable.radius - apart[steps > 2].min()))
