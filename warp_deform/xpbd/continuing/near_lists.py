"""`NearLists`: one world's share of the near pairs that the lanes of a group list together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..lanes.tape import COUNTERS
from ..packing.data import SolverData
from ..packing.mirrored import Mirrored

__all__ = ["NearLists"]


class NearLists:
    """Takes the pairs of worlds off the lists of their groups, and puts them on again.

    A group's list is the union of the pairs of its lanes in canonical order, with a mask. Lanes
    that do not take part in a launch are left off it when it is made anew; their pairs are parked
    here, as numbers within their topology.

    Args:
        arrays: near.pair and near.mask
        counters: of the kernel, by group * COUNTERS; how many pairs are listed is the second
    """

    def __init__(
        self, data: SolverData, arrays: Mapping[str, Mirrored], counters: Mirrored
    ) -> None:
        self._data, self._counters = data, counters.view.reshape(-1, COUNTERS)
        self._pair, self._mask = arrays["near.pair"].view, arrays["near.mask"].view
        self.parked: dict[int, np.ndarray] = {}

    def _place(self, world: int) -> tuple[int, int, slice, int]:
        """Group and lane, where the list stands, and the number of its topology's first pair."""
        data = self._data
        group, lane = divmod(int(data.slot[world]), data.lanes)
        start = int(data.views["group.near_start"][group])
        rows = slice(start, start + int(self._counters[group, 1]))
        return group, lane, rows, int(data.views["topology.pair_start"][data.world_topology[world]])

    def pairs(self, world: int) -> np.ndarray:
        """A copy of a world's near pairs, listed or parked."""
        if world in self.parked:
            return self.parked[world].copy()
        _, lane, rows, first = self._place(world)
        pairs: np.ndarray = self._pair[rows][self._mask[rows, lane] > 0] - np.int32(first)
        return pairs

    def park(self, world: int) -> None:
        """Keep a world's pairs here while it pauses."""
        self.parked[world] = self.pairs(world)

    def unpark(self, world: int) -> None:
        """Put the pairs of a world that goes on back on its group's list."""
        group, lane, rows, first = self._place(world)
        pairs = self.parked.pop(world) + np.int32(first)
        if not len(pairs):
            self._mask[rows, lane] = 0
            return
        union = np.union1d(self._pair[rows], pairs)
        masks = np.zeros((len(union), self._data.lanes), self._mask.dtype)
        masks[np.searchsorted(union, self._pair[rows])] = self._mask[rows]
        masks[:, lane] = np.isin(union, pairs)
        room = int(self._data.views["group.near_capacity"][group])
        # pairs that only ended worlds had listed make place
        keep = masks.any(axis=1)
        union, masks = union[keep][:room], masks[keep][:room]
        place = slice(rows.start, rows.start + len(union))
        self._pair[place], self._mask[place] = union, masks
        self._counters[group, 1] = len(union)
