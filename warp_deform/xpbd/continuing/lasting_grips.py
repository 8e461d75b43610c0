"""`LastingGrips`: what worlds hold between launches, along paths that grow on the way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..packing.data import SolverData
from ..packing.mirrored import Mirrored

__all__ = ["KNOTS", "MOST", "PER_WORLD", "LastingGrips"]

KNOTS = 18
"""Room for the knots of a world: where the tip is, those ahead of it, and one beyond."""
MOST = KNOTS - 2
"""Knots that may be added at once."""
BEYOND = 1.0e6
"""Time [s] of the knot that ends every path, at the place of the one before it: as it is never
reached, nothing is let go."""
PER_WORLD = ("particle", "body", "offset", "turn", "tick", "shift", "lower_start", "lower_end")
"""Arrays of a grip that say nothing about its knots."""
_AT_KNOTS = ("time", "position", "rotation")


class LastingGrips:
    """The arrays of the struct `Grips`, with room of its own for the knots of every world.

    A knot's time is a number of substeps times their length, in the kernel's own arithmetic: a tip
    that has done these substeps is exactly there, and what knots follow changes nothing before it.

    Args:
        dt: length of a substep [s]
    """

    def __init__(self, data: SolverData, dt: float) -> None:
        slots = data.group_count * data.lanes
        names = [name for name in data.arrays if name.startswith("grips.")]
        self.arrays: dict[str, Mirrored] = {
            name: data.arrays[name].like(
                slots * KNOTS if name.removeprefix("grips.") in _AT_KNOTS else None
            )
            for name in names
        }
        self._views = {name.removeprefix("grips."): a.view for name, a in self.arrays.items()}
        self._number, self._dt = data.number, data.number(dt)
        for name in ("particle", "body", "push"):
            self._views[name][:] = -1

    def hold(
        self,
        slot: int,
        *,
        particle: int = -1,
        body: int = -1,
        offset: np.ndarray,
        turn: np.ndarray,
        position: np.ndarray,
        rotation: np.ndarray,
    ) -> None:
        """Hold a particle or a body; the tip waits at `position` (3,) and `rotation` (4,)."""
        first = slot * KNOTS
        for name, value in (
            ("particle", particle), ("body", body), ("offset", offset), ("turn", turn),
            ("tick", 0), ("shift", 0.0), ("lower_start", 0.0), ("lower_end", 0.0),
            ("knot", first), ("knot_end", first + 2),
        ):  # fmt: skip
            self._views[name][slot] = value
        rows = slice(first, first + 2)
        self._views["time"][rows] = 0.0, BEYOND
        self._views["position"][rows] = position
        self._views["rotation"][rows] = rotation

    def let_go(self, slot: int) -> None:
        """Hold nothing."""
        self._views["particle"][slot] = self._views["body"][slot] = -1

    def held(self, slot: int) -> tuple[int, int]:
        """Numbers of the particle and of the body that a slot holds, -1 for none."""
        return int(self._views["particle"][slot]), int(self._views["body"][slot])

    def holding(self, slots: np.ndarray) -> np.ndarray:
        """Which of the slots (S,) hold something (S,)."""
        held: np.ndarray = (self._views["particle"][slots] >= 0) | (self._views["body"][slots] >= 0)
        return held

    def target(self, slots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the paths of the slots (S,) end: positions (S, 3) [m], rotations (S, 4)."""
        last = self._views["knot_end"][slots] - 1
        return self._views["position"][last].copy(), self._views["rotation"][last].copy()

    def append(
        self, slots: np.ndarray, substeps: int, positions: np.ndarray, rotations: np.ndarray
    ) -> None:
        """Let the paths of the slots (S,) go on through K knots, the last of them `substeps` ahead.

        Their tips stand at the last knot but the one beyond; all before it are dropped.

        Args:
            positions: (S, K, 3) [m]
            rotations: (S, K, 4) quat_xyzw, on either side
        """
        count, views = positions.shape[1], self._views
        first, last = slots * KNOTS, views["knot_end"][slots] - 2
        for name in _AT_KNOTS:
            views[name][first] = views[name][last]
        views["knot"][slots] = first
        at = first + 1
        ticks = views["tick"][slots]
        for k in range(count):
            clock = (ticks + substeps * (k + 1) // count).astype(self._number) * self._dt
            views["time"][at] = clock
            views["position"][at] = positions[:, k]
            before, turn = views["rotation"][at - 1], rotations[:, k].astype(self._number)
            other_side = (before * turn).sum(axis=1, keepdims=True) < 0
            views["rotation"][at] = np.where(other_side, -turn, turn)
            at = at + 1
        views["time"][at] = BEYOND
        for name in ("position", "rotation"):
            views[name][at] = views[name][at - 1]
        views["knot_end"][slots] = at + 1

    def save(self, slot: int) -> dict[str, np.ndarray]:
        """A copy of what a slot holds, and of the part of its path that it is still to follow."""
        knot, end = int(self._views["knot"][slot]), int(self._views["knot_end"][slot])
        saved = {name: self._views[name][slot : slot + 1].copy() for name in PER_WORLD}
        return saved | {name: self._views[name][knot:end].copy() for name in _AT_KNOTS}

    def restore(self, slot: int, saved: Mapping[str, np.ndarray]) -> None:
        """Go on from what `save` has copied."""
        first, count = slot * KNOTS, len(saved["time"])
        for name in PER_WORLD:
            self._views[name][slot] = saved[name][0]
        for name in _AT_KNOTS:
            self._views[name][first : first + count] = saved[name]
        self._views["knot"][slot] = first
        self._views["knot_end"][slot] = first + count
