"""Zones: flat marks on the table that show a target. They are drawn, never simulated."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ..support.checked import real_array
from .colors import TARGET, Color

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here

_LIFT = 0.001  # [m] above the table, as the original's 1 mm high markers


@dataclass(frozen=True, eq=False)
class Zone:
    """A set of flat quadrilaterals of one colour.

    Attributes:
        corners: (quads, 4, 3) in order around each quadrilateral [m].
    """

    corners: np.ndarray
    color: Color = TARGET

    def __post_init__(self) -> None:
        quads = len(self.corners) if np.ndim(self.corners) == 3 else 1
        real_array(self.corners, (quads, 4, 3), name="Zone.corners", finite=True)


def _bar(start: np.ndarray, end: np.ndarray, width: float, height: float) -> np.ndarray:
    """Corners (4, 3) of a straight bar of `width` from `start` to `end` (2,) [m]."""
    along = (end - start) / max(float(np.hypot(*(end - start))), 1e-9)
    side = np.array([-along[1], along[0]]) * width / 2
    xy = np.array([start - side, end - side, end + side, start + side])
    return np.column_stack([xy, np.full(4, height)])


def segment_zone(points: np.ndarray, *, width: float = 0.01, height: float = _LIFT) -> Zone:
    """Bars along the polyline `points` (n, 2) [m]: the target of cable-shape."""
    points = np.asarray(points, dtype=float)
    pairs = itertools.pairwise(points)
    return Zone(np.array([_bar(a, b, width, height) for a, b in pairs if not np.allclose(a, b)]))


def square_zone(
    centre: tuple[float, float], yaw: float, side: float, *, rim: float = 0.1, height: float = _LIFT
) -> Zone:
    """Square outline, outer side `side` [m], rim a share `rim` of half of it (the paper's 10 %)."""
    half = side / 2
    inner = half * (1 - rim)
    middle, width = (half + inner) / 2, half - inner
    ends = np.array([[-half, -middle], [half, -middle]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s], [s, c]])
    corners = []
    for _ in range(4):
        a, b = ends @ rotation.T + np.asarray(centre)
        corners.append(_bar(a, b, width, height))
        ends = ends @ turn.T
    return Zone(np.array(corners))


def ring_zone(centres: np.ndarray, *, side: float = 0.01, height: float = 0.002) -> Zone:
    """Small squares at `centres` (n, 2) [m]: the target of cable-ring."""
    half = side / 2
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    xy = np.asarray(centres, dtype=float)[:, None, :] + square
    return Zone(np.concatenate([xy, np.full((*xy.shape[:2], 1), height)], axis=2))
