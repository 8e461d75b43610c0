"""`GuardNotes`: what the guards have noted of worlds since each has begun."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..guards import GuardLimits, Problem, WatchValues
from ..lanes.tape import RunColumn
from ..packing.data import WATCHED, SolverData
from ..packing.mirrored import Mirrored

__all__ = ["GuardNotes"]


class GuardNotes:
    """Reads the arrays of the struct `Watch`, world by world.

    Args:
        arrays: by name, "watch.stretch" and the like
    """

    def __init__(self, data: SolverData, arrays: Mapping[str, Mirrored]) -> None:
        self._views = {name: arrays[f"watch.{name}"].view for name in WATCHED}
        self._group, self._lane = np.divmod(data.slot, data.lanes)

    def clear(self, worlds: np.ndarray) -> None:
        """Nothing is noted of the worlds yet."""
        for view in self._views.values():
            view[self._group[worlds], self._lane[worlds]] = 0

    def _seen(self, worlds: np.ndarray, runs: np.ndarray) -> dict[str, np.ndarray]:
        """What is noted of the worlds (W,).

        Args:
            runs: of all worlds, see `RunColumn`
        """
        at = self._group[worlds], self._lane[worlds]
        seen = {name: view[at] for name, view in self._views.items()}
        # these the kernel writes for all worlds of a group
        for name, column in (("steps", RunColumn.STEPS), ("clamped", RunColumn.CLAMPED)):
            seen[name] = runs[worlds, column]
        return seen

    def problems(
        self, worlds: np.ndarray, limits: GuardLimits, runs: np.ndarray
    ) -> dict[int, tuple[Problem, ...]]:
        """Guards that have fired in the worlds, of those where one has."""
        seen = self._seen(worlds, runs)
        bad = (seen["nonfinite"] > 0) | (seen["overflow"] > 0)
        for name, limit in (
            ("stretch", limits.stretch), ("depth", limits.depth), ("box_depth", limits.box_depth),
            ("box_overlap", limits.box_overlap), ("clamped", limits.clamped_steps),
        ):  # fmt: skip
            bad |= seen[name] > limit
        if not bad.any():
            return {}
        return {int(w): self.values(int(w), runs).problems(int(w), limits) for w in worlds[bad]}

    def values(self, world: int, runs: np.ndarray) -> WatchValues:
        """What is noted of a world, as of one launch."""
        seen = {name: value.item() for name, value in self._seen(np.array([world]), runs).items()}
        whole = {name: int(seen.pop(name)) for name in ("steps", "clamped", "overflow")}
        return WatchValues(**whole, nonfinite=seen.pop("nonfinite") > 0, **seen)
