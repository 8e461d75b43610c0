"""`WorldRun`: what one world goes on from in the midst of a launch, besides its state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..packing.data import WATCHED, SolverData
from ..packing.mirrored import Mirrored

__all__ = ["WorldRun", "lists_of", "places_of"]


@dataclass(frozen=True, eq=False)
class WorldRun:
    """What `ContinuedLaunch.save` copies of a world, in the solver's precision.

    Attributes:
        run: what the kernel keeps between two parts, see `RunColumn`
        pairs: near pairs, numbered within the topology
        arrays: of the solver by name, the world's share
        grip: see `LastingGrips.save`
    """

    run: np.ndarray
    pairs: np.ndarray
    arrays: Mapping[str, np.ndarray]
    grip: Mapping[str, np.ndarray]

    @property
    def held(self) -> tuple[int, int]:
        """Numbers of the held particle and of the held body, -1 for none."""
        return int(self.grip["particle"][0]), int(self.grip["body"][0])


def places_of(data: SolverData, own: Mapping[str, Mirrored], world: int) -> dict[str, np.ndarray]:
    """Writable views of a world's share of all arrays that last, but positions and velocities.

    Args:
        own: arrays in place of the solver's of the same names
    """
    group, lane = divmod(int(data.slot[world]), data.lanes)
    slot = slice(group * data.lanes + lane, group * data.lanes + lane + 1)
    rows = data.body_rows(world)
    places = {f"particles.{n}": data.lane(f"particles.{n}", world) for n in ("w", "xr")}
    places["particles.tether"] = data.lane_of(own["particles.tether"], world)
    places |= {f"bodies.{n}": data.views[f"bodies.{n}"][rows] for n in ("w", "touching", "support")}
    places |= {f"watch.{n}": own[f"watch.{n}"].view[group, lane : lane + 1] for n in WATCHED}
    if data.has_sheets:
        places |= {f"cells.{n}": data.lane(f"cells.{n}", world) for n in ("xr", "slack")}
        places |= {f"cells.{n}": data.views[f"cells.{n}"][slot] for n in ("count", "met")}
        count = data.topologies[data.world_topology[world]].particle_count
        first = int(data.group_particle[group]) * data.lanes + lane * count
        places["cells.place"] = data.views["cells.place"][first : first + count]
    if data.has_edges:
        places["cells.edge_count"] = data.views["cells.edge_count"][slot]
        edges = len(data.topologies[data.world_topology[world]].sheet_edge)
        first = int(data.views["cells.link_start"][group]) + lane * edges
        places["cells.edge_ball"] = data.views["cells.edge_ball"][first : first + edges]
    return places


def lists_of(data: SolverData, world: int) -> dict[str, np.ndarray]:
    """Writable views of a world's pairs of triangles and edges, as many as there are now."""
    group, lane = divmod(int(data.slot[world]), data.lanes)
    out = {}
    for has, count, names in (
        (data.has_sheets, "count", ("particle", "face", "gap")),
        (data.has_edges, "edge_count", ("edge_a", "edge_b", "edge_gap")),
    ):
        if has:
            first = int(data.views["cells.list_start"][group])
            first += lane * int(data.views["cells.capacity"][group])
            listed = int(data.views[f"cells.{count}"][group * data.lanes + lane])
            for name in names:
                out[f"cells.{name}"] = data.views[f"cells.{name}"][first : first + listed]
    return out
