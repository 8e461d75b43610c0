"""Springs and sizes of particles: what the worlds of one topology have in common."""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from ...objects.attributes import SpringMode
from .data import SolverData

__all__ = ["PARTS", "parts", "set_parts"]

PARTS = ("spring_stiffness", "rest_lengths", "radii")


def parts(data: SolverData, world: int, name: str) -> np.ndarray:
    """A world's stiffness of springs (S,) [N/m], rest lengths (S,) [m] or radii (P,) [m]."""
    springs, particles = _rows(data, int(data.world_topology[world]))
    if name == "radii":
        return data.views["topology.radius"][particles].copy()
    if name == "rest_lengths":
        return data.views["springs.length"][springs].copy()
    stiffness: np.ndarray = 1.0 / data.views["springs.compliance"][springs]
    return stiffness


def set_parts(data: SolverData, world: int, name: str, values: np.ndarray) -> None:
    """Set what `parts` gives, for all worlds of this world's topology; no fabric sleeps on.

    Strain limits and floors keep their share of a rest length. Everything else stays as it is: the
    shape at rest that says which particles may touch, tethers, and the skin of fabrics.

    Raises:
        InputError: numbers of another shape, not finite or not positive; a BEAM spring with a rest
            length. Only a BEND spring may have the rest length 0.
    """
    k = int(data.world_topology[world])
    top = data.topologies[k]
    count = top.particle_count if name == "radii" else len(top.spring_ij)
    values = np.asarray(values, dtype=float)
    if values.shape != (count,):
        raise InputError(f"{name} must have the shape {(count,)}, not {values.shape}")
    may_be_zero = np.zeros(count, bool)
    if name == "rest_lengths":
        may_be_zero = np.isin(top.spring_mode, (SpringMode.BEND, SpringMode.BEAM))
        if values[top.spring_mode == int(SpringMode.BEAM)].any():
            raise InputError("a BEAM spring needs rest length 0: only BEND springs have another")
    if not np.isfinite(values).all() or not ((values > 0) | (may_be_zero & (values == 0))).all():
        raise InputError(f"{name} must be positive numbers, got {values.min()}")
    springs, particles = _rows(data, k)
    data.edits += 1
    if name == "radii":
        data.views["topology.radius"][particles] = values
        start = data.views["topology.pair_start"]
        distance = values[top.pair_ij].sum(axis=1)
        data.views["pairs.distance"][int(start[k]) : int(start[k + 1])] = distance
    elif name == "rest_lengths":
        data.views["springs.length"][springs] = values
        given = np.where(top.spring_length > 0, top.spring_length, 1.0)
        for field, bound in (("limit", top.spring_limit), ("floor", top.spring_floor)):
            data.views[f"springs.{field}"][springs] = bound / given * values
    else:
        data.views["springs.compliance"][springs] = 1.0 / values
    for other in np.flatnonzero(data.world_topology == k):
        data.wake(int(other))


def _rows(data: SolverData, topology: int) -> tuple[slice, slice]:
    """Where the springs and the particles of a topology stand."""
    first = int(data.views["topology.spring_start"][topology])
    particle = int(data.views["topology.particle_start"][topology])
    top = data.topologies[topology]
    return (
        slice(first, first + len(top.spring_ij)),
        slice(particle, particle + top.particle_count),
    )
