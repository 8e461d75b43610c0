"""Pulls on a fabric's corners: how far they may go, and whether the tip would take the corner."""

from __future__ import annotations

import numpy as np

from ..objects.cloth import ClothConfig
from ..rendering.pixels import BOUNDS
from ..robots.primitive import PrimitiveConfig
from .demonstrators import met_particle
from .task import Action, Snapshot

__all__ = ["beyond", "corners", "first_taken", "on_table", "takes"]

_LOW, _HIGH = np.array(BOUNDS[:2]).T


def corners(fabric: ClothConfig, snapshot: Snapshot) -> np.ndarray:
    """Where the vertices one cell inwards of the fabric's corners are (4, 3) [m]."""
    return np.array(snapshot.particle_q[list(fabric.inner_corners)], dtype=float)


def beyond(pick: np.ndarray, target: np.ndarray, overshoot: float) -> np.ndarray:
    """Point (2,) [m] that lies `overshoot` behind `target` as seen from `pick`; negative: before.

    Beyond the target it ends at the table's edge; a target off the table stays where it is.
    """
    pick, target = np.asarray(pick, dtype=float)[:2], np.asarray(target, dtype=float)[:2]
    way = target - pick
    length = float(np.linalg.norm(way))
    if length == 0:
        return target
    step = way / length
    edge = np.where(step > 0, _HIGH, _LOW)
    room = float(((edge - target)[step != 0] / step[step != 0]).min())
    return np.asarray(target + step * min(overshoot, max(room, 0.0)))


def on_table(points: np.ndarray) -> np.ndarray:
    """Which of `points` (..., 2 or 3) [m] lie above the workspace."""
    xy = np.asarray(points, dtype=float)[..., :2]
    return np.asarray(((xy >= _LOW) & (xy <= _HIGH)).all(axis=-1))


def takes(vertex: int, fabric: ClothConfig, snapshot: Snapshot, primitive: PrimitiveConfig) -> bool:
    """Whether a tip that descends on a vertex takes it, or one within a cell of it."""
    taken = met_particle(snapshot.particle_q[vertex, :2], snapshot, primitive)
    if taken is None:
        return False
    cells = np.subtract(divmod(taken, fabric.columns), divmod(vertex, fabric.columns))
    return bool(np.abs(cells).max() <= 1)


def first_taken(
    pulls: dict[int, Action], fabric: ClothConfig, snapshot: Snapshot, primitive: PrimitiveConfig
) -> Action | None:
    """The first of `pulls`, by vertex, whose vertex the tip really takes; else the first."""
    taken = [v for v in pulls if takes(v, fabric, snapshot, primitive)]
    return next((pulls[v] for v in [*taken, *pulls]), None)
