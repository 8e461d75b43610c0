"""`Selection`: how some worlds are run together, worked out once for many parts of a launch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..packing.data import SolverData

__all__ = ["Selection", "selection_of"]


@dataclass(frozen=True, eq=False)
class Selection:
    """How some worlds are run together.

    Attributes:
        worlds: their numbers (W,)
        held: which of them hold something (S,), by place in `worlds`
        slots: of these (S,)
        scalars: (W, P, 3), where arrays of particles have their single scalars, if all of them are
            of one topology; None where there are no worlds
    """

    worlds: np.ndarray
    held: np.ndarray
    slots: np.ndarray
    scalars: np.ndarray | None


def selection_of(data: SolverData, worlds: np.ndarray, held: np.ndarray) -> Selection:
    """The selection of worlds (W,), of which `held` (S,) hold something."""
    scalars: np.ndarray | None = None
    if len(worlds):
        group, lane = np.divmod(data.slot[worlds], data.lanes)
        count = data.topologies[data.world_topology[worlds[0]]].particle_count
        rows = data.group_particle[group][:, None, None] + np.arange(count)[:, None]
        scalars = (rows * 3 + np.arange(3)) * data.lanes + lane[:, None, None]
    return Selection(worlds, held, data.slot[worlds[held]], scalars)
