"""Worlds of a model sorted into groups of SIMD lanes, and named arrays for them."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from ...objects.attributes import SpringMode
from ..lanes.structures import structures
from .mirrored import Mirrored
from .topology import WorldTopology, read_worlds

__all__ = ["NUMPY", "PackedWorlds"]

NUMPY = {wp.float32: np.float32, wp.float64: np.float64}
"""NumPy's scalars by Warp's."""


class PackedWorlds:
    """The groups of a model's worlds in one precision and lane width, and room for arrays.

    World w lives in group ``slot[w] // L``, lane ``slot[w] % L``. Every array is a `Mirrored` under
    ``arrays["struct.field"]``; `views` gives their NumPy views by the same names.
    """

    def __init__(self, model: newton.Model, *, scalar: Any, lanes: int) -> None:
        self.model = model
        self.device = model.device
        self.scalar, self.lanes = scalar, lanes
        self.number = NUMPY[scalar]
        self.types = structures(scalar, lanes)
        worlds, self.particle_ids, self.body_ids = read_worlds(model)
        self.world_count = len(worlds)
        self._group(worlds)
        self.arrays: dict[str, Mirrored] = {}
        self.views: dict[str, np.ndarray] = {}

    def _group(self, worlds: list[WorldTopology]) -> None:
        """Sort worlds into groups of equal topology, in world order within each."""
        keys: dict[bytes, int] = {}
        members: list[list[int]] = []
        self.topologies: list[WorldTopology] = []
        for w, topology in enumerate(worlds):
            k = keys.setdefault(topology.key(), len(keys))
            if k == len(members):
                members.append([])
                self.topologies.append(topology)
            members[k].append(w)
        self.slot = np.zeros(self.world_count, int)
        self.world_topology = np.zeros(self.world_count, int)
        self.group_topology: list[int] = []
        for k, list_ in enumerate(members):
            for begin in range(0, len(list_), self.lanes):
                group = len(self.group_topology)
                self.group_topology.append(k)
                for lane, w in enumerate(list_[begin : begin + self.lanes]):
                    self.slot[w] = group * self.lanes + lane
                    self.world_topology[w] = k
        self.group_count = len(self.group_topology)
        sizes = [self.topologies[k].particle_count for k in self.group_topology]
        bodies = [self.topologies[k].body_count * self.lanes for k in self.group_topology]
        self.group_particle = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        self.group_body = np.concatenate([[0], np.cumsum(bodies)]).astype(int)
        self.has_bodies = bool(self.group_body[-1] > 0)
        self.has_particles = self.group_particle[-1] > 0
        # both need the kernel with fabrics
        self.has_sheets = any(
            len(top.sheet_triangle) > 0 or bool((top.spring_floor > 0).any())
            for top in self.topologies
        )
        # what is compiled in although a scene has none of it changes no bit of what it has. The
        # kernels below differ by a tenth of their code: one that serves both is compiled once.
        checks = self.scalar == wp.float64
        self.has_lines = (
            checks
            or (self.has_bodies and not self.has_sheets)
            or any(bool((top.spring_mode >= SpringMode.CHAIN).any()) for top in self.topologies)
        )
        self.has_edges = (checks and self.has_sheets) or any(
            len(top.sheet_edge) > 0 for top in self.topologies
        )

    @property
    def variant(self) -> tuple[Any, int, bool, bool, bool, bool]:
        """The first arguments of `forward_kernel` and `adjoint_kernel` for these worlds.

        Double precision is for checks: one kernel serves worlds alone, as what is
        compiled in although a scene has none of it changes no bit of what it has.
        """
        parts = self.has_bodies, self.has_sheets, self.has_edges, self.has_lines
        every = (True, True, True, True)
        checks = self.scalar == wp.float64 and self.lanes == 1
        return (self.scalar, self.lanes, *(every if checks else parts))

    def add_array(
        self, name: str, count: int, dtype: Any, shape: tuple[int, ...], number: Any
    ) -> np.ndarray:
        """Add the array "struct.field" of `count` elements; returns its view."""
        self.arrays[name] = array = Mirrored(count, dtype, self.device, number, shape)
        self.views[name] = array.view
        return array.view

    def add_constant(self, name: str, values: np.ndarray, dtype: Any, number: Any) -> None:
        """Add an array that holds `values`."""
        values = np.asarray(values)
        self.add_array(name, len(values), dtype, values.shape[1:], number)[: len(values)] = values
