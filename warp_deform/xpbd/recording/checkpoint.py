"""Copies of what a launch changes, so that a rollout can be run again from within."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..config import WORLD_PARAMETERS
from ..packing.data import WATCHED, SolverData
from ..packing.mirrored import Mirrored

__all__ = ["INPUTS", "Checkpoints"]

_STATE = (
    "particles.x", "particles.v", "particles.xp", "particles.xr", "particles.w",
    "particles.still", "particles.anchor", "near.pair",
    "near.mask", "grips.particle", "grips.body", "grips.tick", "grips.knot", "grips.shift",
    "bodies.x", "bodies.q", "bodies.v", "bodies.omega", "bodies.xp", "bodies.qp", "bodies.w",
    "bodies.touching", "bodies.support", *(f"watch.{name}" for name in WATCHED),
)  # fmt: skip
"""What a launch changes and a later one needs; the lists of fabrics are trimmed to their length."""
INPUTS = (
    "springs.length", "springs.compliance", "springs.limit", "springs.floor", "topology.radius",
    "pairs.distance", "particles.w0", "particles.tether", "bodies.w0", "bodies.inertia",
    "bodies.inverse_inertia", "shapes.friction", "shapes.center", "shapes.half",
    "shapes.rotation", "group.active", *(f"group.{name}" for name in WORLD_PARAMETERS),
    "group.gravity", "group.calm_steps", "group.calm_after", "group.least_steps",
    "group.most_steps", "grips.knot_end", "grips.offset", "grips.turn", "grips.lower_start",
    "grips.lower_end", "grips.push", "grips.push_steps", "grips.push_acceleration", "grips.time",
    "grips.position", "grips.rotation",
)  # fmt: skip
"""What whoever sets a rollout up may change, and no launch does."""
_SHEET_STATE = ("cells.count", "cells.met", "cells.xr", "cells.slack", "cells.place")
_LISTS = {
    "cells.count": ("cells.particle", "cells.face", "cells.gap"),
    "cells.edge_count": ("cells.edge_a", "cells.edge_b", "cells.edge_gap"),
}


class Checkpoints:
    """Saves and restores what launches change: a solver's arrays and the kernel's own `control`.

    The arrays are those that the solver has now, even if it replaces some of them later.

    Args:
        own: arrays in place of the solver's of the same names
    """

    def __init__(
        self,
        data: SolverData,
        control: Mapping[str, Mirrored],
        own: Mapping[str, Mirrored] | None = None,
    ) -> None:
        self.data, self._control, self._arrays = data, control, {**data.arrays, **(own or {})}
        self._held = [name for name in _STATE if name in data.arrays]
        if data.has_sheets:
            self._held += _SHEET_STATE
        if data.has_edges:
            self._held += ["cells.edge_count", "cells.edge_ball"]

    def save_inputs(self) -> dict[str, np.ndarray]:
        """A copy of what a rollout is set up with, besides the state that it starts from."""
        return {name: self._arrays[name].view.copy() for name in INPUTS}

    def restore_inputs(self, saved: Mapping[str, np.ndarray]) -> None:
        for name in INPUTS:
            self._arrays[name].view[...] = saved[name]
            self._arrays[name].to_device()

    def save(self) -> dict[str, np.ndarray]:
        """A copy of everything that the next substep depends on."""
        saved: dict[str, np.ndarray] = {}
        for name in self._held:
            self._arrays[name].to_host()
            saved[name] = self._arrays[name].view.copy()
        for name, mirrored in self._control.items():
            mirrored.to_host()
            saved[name] = mirrored.view.copy()
        for count, lists in _LISTS.items():
            if count in saved:
                rows = self._rows(saved[count])
                for name in lists:
                    self._arrays[name].to_host()
                    saved[name] = self._arrays[name].view[rows]
        return saved

    def _rows(self, counts: np.ndarray) -> np.ndarray:
        """Rows of the lists of fabrics that hold something, of all worlds."""
        start, capacity = (
            self._arrays[f"cells.{n}"].view[:, None] for n in ("list_start", "capacity")
        )
        first = (start + np.arange(self.data.lanes) * capacity).ravel()
        counts = counts[: len(first)]
        behind = np.cumsum(counts)
        rows: np.ndarray = np.repeat(first - (behind - counts), counts) + np.arange(behind[-1])
        return rows

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        for name in self._held:
            self._arrays[name].view[...] = saved[name]
            self._arrays[name].to_device()
        for name, mirrored in self._control.items():
            mirrored.view[...] = saved[name]
            mirrored.to_device()
        for count, lists in _LISTS.items():
            if count in saved:
                rows = self._rows(saved[count])
                for name in lists:
                    self._arrays[name].view[rows] = saved[name]
                    self._arrays[name].to_device()
