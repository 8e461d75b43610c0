"""`GuardNotes`: what the guards have noted of worlds since each has begun."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..guards import GuardLimits, Problem, WatchValues
from ..lanes.tape import RunColumn
from ..packing.data import WATCHED, SolverData
from ..packing.mirrored import Mirrored
from .lane_runs import LaneRuns

__all__ = ["GuardNotes"]

_LIMITS = {"stretch": "stretch", "depth": "depth", "box_depth": "box_depth",
           "box_overlap": "box_overlap", "clamped": "clamped_steps"}  # fmt: skip
"""Fields of `GuardLimits`; what is noted elsewhere must be 0."""
_GUARDED = tuple(name for name in WATCHED if name != "steps")


class GuardNotes:
    """Reads the arrays of the struct `Watch`, world by world.

    Args:
        arrays: by name, "watch.stretch" and the like
    """

    def __init__(self, data: SolverData, arrays: Mapping[str, Mirrored]) -> None:
        self._views = {name: arrays[f"watch.{name}"].view for name in WATCHED}
        self._group, self._lane = np.divmod(data.slot, data.lanes)
        self._limits: tuple[GuardLimits, np.ndarray] | None = None

    def clear(self, worlds: np.ndarray) -> None:
        """Nothing is noted of the worlds yet."""
        for view in self._views.values():
            view[self._group[worlds], self._lane[worlds]] = 0

    def _seen(self, worlds: np.ndarray, runs: LaneRuns) -> dict[str, np.ndarray]:
        """What is noted of the worlds (W,).

        Args:
            runs: of all worlds
        """
        at = self._group[worlds], self._lane[worlds]
        seen = {name: view[at] for name, view in self._views.items()}
        # these the kernel writes for all worlds of a group
        rows = runs.rows(worlds)
        for name, column in (("steps", RunColumn.STEPS), ("clamped", RunColumn.CLAMPED)):
            seen[name] = rows[:, column]
        return seen

    def problems(
        self, worlds: np.ndarray, limits: GuardLimits, runs: LaneRuns
    ) -> dict[int, tuple[Problem, ...]]:
        """Guards that have fired in the worlds, of those where one has."""
        if self._limits is None or self._limits[0] is not limits:
            # one comparison for all: it is made after every control step
            self._limits = (
                limits,
                np.repeat(
                    [getattr(limits, _LIMITS[n]) if n in _LIMITS else 0.0 for n in _GUARDED],
                    len(self._views["stretch"].ravel()),
                ),
            )
        if not (np.concatenate([self._views[n].ravel() for n in _GUARDED]) > self._limits[1]).any():
            return {}
        seen = self._seen(worlds, runs)
        bad = np.zeros(len(worlds), bool)
        for name in _GUARDED:
            bad |= seen[name] > (getattr(limits, _LIMITS[name]) if name in _LIMITS else 0.0)
        fired = {int(w): self.values(int(w), runs).problems(int(w), limits) for w in worlds[bad]}
        return {w: problems for w, problems in fired.items() if problems}

    def values(self, world: int, runs: LaneRuns) -> WatchValues:
        """What is noted of a world, as of one launch."""
        seen = {name: value.item() for name, value in self._seen(np.array([world]), runs).items()}
        whole = {name: int(seen.pop(name)) for name in ("steps", "clamped", "overflow")}
        return WatchValues(**whole, nonfinite=seen.pop("nonfinite") > 0, **seen)
