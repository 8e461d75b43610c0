"""What the scripted demonstrators share: where to pick, how to place, which bead goes where.

Source: Seita et al., ICRA 2021, section on demonstrators.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..rendering.pixels import pixel_to_world
from ..robots.primitive import PrimitiveConfig, find_grasp
from .metrics import wrap_angle
from .task import Action, Snapshot, Stage

__all__ = [
    "best_map",
    "farthest_bead",
    "met_particle",
    "nearest_shift",
    "pick_place",
    "pick_place_pose",
    "ring_maps",
    "visible_point",
]

_MAP_TURNS, _SHIFT_TURNS = 8, 200
_STILL = 1e-9
"""Change of a shift that no longer counts [m]."""


def visible_point(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Point x, y (2,) [m] of a pixel drawn uniformly from `mask` (320, 160) eroded by 3 x 3.

    None when nothing is left: what the mask shows is hidden, or too small to hit safely.
    """
    eroded = cv2.erode(np.asarray(mask, dtype=np.uint8), np.ones((3, 3), np.uint8))
    pixels = np.argwhere(eroded)
    return pixel_to_world(pixels[rng.integers(len(pixels))]) if len(pixels) else None


def pick_place(
    pick: np.ndarray, place: np.ndarray, *, stage: Stage, place_yaw: float = 0.0
) -> Action:
    """Action (7,) float64 from `pick` (2,), yaw 0, to `place` (2,) [m] at `place_yaw` [rad]."""
    return np.array([*pick[:2], 0.0, *place[:2], place_yaw, stage.lift], dtype=float)


def pick_place_pose(
    pick: np.ndarray, pose: np.ndarray, target: np.ndarray, *, stage: Stage
) -> Action:
    """Action (7,) that takes a rigid body from `pose` to `target`, both (3,) x, y [m], yaw [rad].

    The held body turns by place yaw minus pick yaw about the pick point (2,) and that point goes to
    the place point; so the place point is where the target's body carries the picked spot.
    """
    turn = wrap_angle(target[2] - pose[2])
    c, s = np.cos(turn), np.sin(turn)
    place = target[:2] + np.array([[c, -s], [s, c]]) @ (pick[:2] - pose[:2])
    return pick_place(pick, place, stage=stage, place_yaw=turn)


def ring_maps(beads: int, *, reversals: bool) -> np.ndarray:
    """Every way (maps, beads) to give a ring's beads to its targets in order around the ring.

    Entry j of a map is the bead for target j: all cyclic shifts and, with `reversals`, those of the
    ring turned over.
    """
    shifts = (np.arange(beads)[:, None] + np.arange(beads)) % beads
    return np.concatenate([shifts, shifts[:, ::-1]]) if reversals else shifts


def best_map(
    beads: np.ndarray, targets: np.ndarray, maps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The map of least mean distance (n,), and the distance to each target under it (n,) [m].

    Args:
        beads: (n, 3) [m]
        targets: (n, 3) [m]
        maps: (m, n), as from `ring_maps`
    """
    distances = np.linalg.norm(beads[:, None] - targets, axis=-1)  # bead, target
    mapped = distances[maps, np.arange(len(targets))]
    best = int(np.argmin(mapped.mean(axis=1)))
    return maps[best], mapped[best]


def nearest_shift(
    beads: np.ndarray,
    targets: np.ndarray,
    maps: np.ndarray,
    *,
    room: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """How far (2,) [m] to shift the targets, all together, to where the beads are nearest to them.

    The least mean distance under the best of the maps, by turns: the map for a shift, and the shift
    for a map. From the shift that joins their centres, so it is a local minimum; beads that lie
    right already hold the targets to where they are.

    Args:
        beads: (n, 2) [m]
        targets: (n, 2) [m]
        maps: (m, n), as from `ring_maps`
        room: least and greatest shift, each (2,) [m]

    Source: Weiszfeld's algorithm for the geometric median, within bounds.
    """
    shift = np.clip(beads.mean(axis=0) - targets.mean(axis=0), *room)
    chosen = -1
    for _ in range(_MAP_TURNS):
        distances = _rounded(beads[maps] - (targets + shift))
        best = int(np.argmin(distances.mean(axis=-1)))
        if best == chosen:
            break
        chosen, offsets = best, beads[maps[best]] - targets
        for _ in range(_SHIFT_TURNS):
            weights, before = 1 / _rounded(offsets - shift), shift
            shift = np.clip(weights @ offsets / weights.sum(), *room)
            if np.abs(shift - before).max() < _STILL:
                break
    return shift


def _rounded(offsets: np.ndarray) -> np.ndarray:
    """Lengths that are never 0, as those of `losses.lengths`."""
    return np.sqrt((offsets**2).sum(axis=-1) + 1e-8)


def farthest_bead(beads: np.ndarray, targets: np.ndarray, maps: np.ndarray) -> tuple[int, int]:
    """Bead and target farthest apart under the map of least mean distance; of equals the first.

    Args:
        beads: (n, 3) [m]
        targets: (n, 3) [m]
        maps: (m, n), as from `ring_maps`
    """
    bead_of, distances = best_map(beads, targets, maps)
    target = int(np.argmax(distances))
    return int(bead_of[target]), target


def met_particle(xy: np.ndarray, snapshot: Snapshot, config: PrimitiveConfig) -> int | None:
    """Number of the particle that a tip descending at `xy` (2,) [m] would take, None if it is none.

    A particle that another one lies on, or leans over, is not met at its own place.
    """
    x_y_yaw = np.array([xy[0], xy[1], 0.0])
    grasp = find_grasp(x_y_yaw, snapshot.objects, snapshot.particle_q, snapshot.body_q, config)
    return None if grasp is None else grasp.particle
