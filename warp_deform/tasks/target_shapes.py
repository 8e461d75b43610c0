"""Target shapes of the cable-shape tasks: one to four sides of a rectangle.

Source: Seita et al., ICRA 2021, appendix on the tasks, and the rules of the published code, which
this follows to the bead: targets start at the +x side, and at a corner neighbours may be 30 %
closer than along a side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..objects.cable import CableConfig

__all__ = ["Shape", "chain_yaw", "sample_shape", "to_world"]

_CUTOFF_MARGIN = 4
"""Fewest beads that 3- and 4-sided shapes leave to either direction, to avoid slivers."""


@dataclass(frozen=True)
class Shape:
    """`sides` consecutive sides of a rectangle whose sides along x get `cutoff` of the beads."""

    sides: int
    cutoff: int

    def __post_init__(self) -> None:
        if self.sides not in (1, 2, 3, 4):
            raise InputError(f"a cable shape has 1 to 4 sides, got {self.sides}")

    def size(self, cable: CableConfig) -> tuple[float, float]:
        """Sides of the rectangle along x and y [m]; the chosen ones add up to the cable."""
        if self.sides == 1:
            return cable.length, 0.0
        along_x = cable.length * self.cutoff / cable.beads
        along_y = cable.length - along_x
        return along_x / (2 if self.sides == 4 else 1), along_y / (1 if self.sides == 2 else 2)

    def outline(self, cable: CableConfig) -> np.ndarray:
        """Corners (sides + 1, 2) [m] of the target in its own frame, from the first bead's on."""
        x, y = np.array(self.size(cable)) / 2
        return {
            1: np.array([[x, 0.0], [-x, 0.0]]),
            2: np.array([[x, -y], [-x, -y], [-x, y]]),
            3: np.array([[x, y], [x, -y], [-x, -y], [-x, y]]),
            4: np.array([[x, -y], [-x, -y], [-x, y], [x, y], [x, -y]]),
        }[self.sides]

    def targets(self, cable: CableConfig) -> np.ndarray:
        """Target (beads, 2) [m] of every bead in the shape's own frame.

        Side k holds the beads from `starts[k]` on, one spacing apart along it. All but the closed
        rectangle begin each side one bead radius after its corner.
        """
        n, c = cable.beads, self.cutoff
        starts = {
            1: [0.0],
            2: [0.0, c],
            3: [0.0, (n - c) / 2, n - (n - c) / 2],
            4: [0.0, c / 2, n / 2, (n + c) / 2],
        }[self.sides]
        inset = 0.0 if self.sides == 4 else cable.radius
        directions = {
            1: [(-1, 0)],
            2: [(-1, 0), (0, 1)],
            3: [(0, -1), (-1, 0), (0, 1)],
            4: [(-1, 0), (0, 1), (1, 0), (0, -1)],
        }[self.sides]
        bead = np.arange(n)
        side = np.searchsorted(starts, bead, side="right") - 1
        along = (bead - np.array(starts)[side]) * cable.spacing + inset
        return self.outline(cable)[side] + along[:, None] * np.array(directions)[side]


def sample_shape(rng: np.random.Generator, sides: tuple[int, ...], beads: int) -> Shape:
    """Draw one of the numbers of `sides`, then the cutoff, as the paper does."""
    count = int(rng.choice(sides))
    if count == 1:
        return Shape(1, 0)
    margin = 0 if count == 2 else _CUTOFF_MARGIN
    return Shape(count, int(rng.integers(margin, beads + 1 - margin)))


def to_world(points: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Points (n, 2) [m] of the planar `frame` (3,) x, y [m], yaw [rad], in the world.

    Examples:
        >>> to_world(np.array([[1.0, 0.0]]), np.array([0.5, 0.0, np.pi / 2])).round(6).tolist()
        [[0.5, 1.0]]
    """
    x, y, yaw = frame
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points, dtype=float) @ np.array([[c, s], [-s, c]]) + [x, y]


def chain_yaw(points: np.ndarray, *, closed: bool) -> np.ndarray:
    """Angle (n,) [rad] of a chain's tangent at each of its `points` (n, 2 or 3) [m].

    Examples:
        >>> points = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]])
        >>> chain_yaw(points, closed=False).round(3).tolist()
        [1.571, 1.571, 1.571]
    """
    xy = np.asarray(points, dtype=float)[:, :2]
    if closed:
        tangent = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    else:
        tangent = np.gradient(xy, axis=0)
    return np.arctan2(tangent[:, 1], tangent[:, 0])
