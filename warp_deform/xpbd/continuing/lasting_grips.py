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

    def append(
        self,
        slots: np.ndarray,
        substeps: int,
        positions: np.ndarray | None,
        rotations: np.ndarray | None,
    ) -> None:
        """Let the paths of the slots (S,) go on through K knots, the last of them `substeps` ahead.

        Their tips stand at the last knot but the one beyond; all before it are dropped.

        Args:
            positions: (S, K, 3) [m]; None: where the tips are
            rotations: (S, K, 4) quat_xyzw, on either side; None: as they are
        """
        views, first = self._views, slots * KNOTS
        time, position, rotation = (views[name] for name in _AT_KNOTS)
        last = views["knot_end"][slots] - 2
        time[first] = time[last]
        place = position[last]
        turn = rotation[last]
        position[first], rotation[first] = place, turn
        count = max(1 if k is None else k.shape[1] for k in (positions, rotations))
        ticks, at = views["tick"][slots], first
        for k in range(count):
            at = at + 1
            time[at] = (ticks + substeps * (k + 1) // count).astype(self._number) * self._dt
            if positions is not None:
                place = positions[:, k]
            position[at] = place
            if rotations is not None:
                given = rotations[:, k].astype(self._number)
                other_side = (turn * given).sum(axis=1, keepdims=True) < 0
                turn = np.where(other_side, -given, given)
            rotation[at] = turn
        at = at + 1
        time[at], position[at], rotation[at] = BEYOND, place, turn
        views["knot"][slots], views["knot_end"][slots] = first, at + 1

    def cut(self, slots: np.ndarray) -> None:
        """Take back what was added last to the paths of the slots (S,), before it was run."""
        views, first = self._views, slots * KNOTS
        for name in _AT_KNOTS:
            views[name][first + 1] = views[name][first]
        views["time"][first + 1] = BEYOND
        views["knot_end"][slots] = first + 2

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
