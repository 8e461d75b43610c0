"""`LaneRuns`: what the kernel keeps of every world between two parts of a launch."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..lanes.tape import COUNTERS, STATE, RunColumn
from ..packing.data import SolverData
from ..packing.mirrored import Mirrored

__all__ = ["LaneRuns"]


class LaneRuns:
    """The kernel's own state by group and lane, and the rows of worlds that are not launched.

    As long as the same worlds are launched again, what the kernel left stays where it is.
    """

    def __init__(self, data: SolverData) -> None:
        lanes, groups, device = data.lanes, data.group_count, data.device
        state = Mirrored(groups * STATE, data.types.V, device, data.number, (lanes,))
        counters = Mirrored(groups * COUNTERS, wp.int32, device, np.int32, ())
        self.control = {"state": state, "counters": counters}
        self._state = state.view.reshape(groups, STATE, lanes)
        self._substeps = counters.view.reshape(-1, COUNTERS)[:groups, 0]
        self._group, self._lane = np.divmod(data.slot, lanes)
        self._rows = np.zeros((data.world_count, STATE), data.number)
        self._live: np.ndarray | None = None
        self._newer = False

    def _fetch(self) -> None:
        """Copy what the kernel left."""
        if self._live is not None and self._newer:
            live = self._live
            self._rows[live] = self._state[self._group[live], :, self._lane[live]]
            self._newer = False

    def rows(self, worlds: np.ndarray) -> np.ndarray:
        """Copies (W, STATE), see `RunColumn`."""
        self._fetch()
        rows: np.ndarray = self._rows[worlds]
        return rows

    def put(self, worlds: np.ndarray, rows: np.ndarray) -> None:
        """Give worlds other rows (W, STATE)."""
        self._fetch()
        self._rows[worlds], self._live = rows, None

    def set(self, world: int, column: RunColumn, value: float) -> None:
        """Give a world another number."""
        self._fetch()
        self._rows[world, column], self._live = value, None

    def launched_last(self, worlds: np.ndarray) -> bool:
        """Whether just this array of worlds was launched last, and nothing was set since."""
        return self._live is worlds

    def enter(self, worlds: np.ndarray) -> None:
        """Write what the kernel needs to launch worlds."""
        if self._live is not worlds:
            self._fetch()
            groups, lanes = self._group[worlds], self._lane[worlds]
            self._state[:, RunColumn.ON] = 0.0
            self._state[groups, :, lanes] = self._rows[worlds]
            self._state[groups, RunColumn.ON, lanes] = 1.0
            self._live = worlds
        self._substeps[:] = 0
        self._newer = True
