"""The solver's working arrays of triangles: what they are, and room for the pairs of every lane."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from .groups import PackedWorlds

__all__ = ["add_sheets"]

_GRID = (4, 64)  # cells of the list along a side, at least and at most


def add_sheets(data: PackedWorlds, pairs_per_particle: int) -> None:
    """Add the arrays of the structs `Sheets` and `Cells` to `data`; tiny ones without triangles."""
    t, number, tops, L = data.types, data.number, data.topologies, data.lanes
    has_sheets = data.has_sheets
    grid = [
        int(np.clip(np.sqrt(top.particle_count), *_GRID)) if len(top.sheet_triangle) else 0
        for top in tops
    ]
    room = [
        pairs_per_particle * tops[k].particle_count if grid[k] else 0 for k in data.group_topology
    ]
    heads = [(grid[k] ** 2 + 1) * L for k in data.group_topology]
    list_start = np.cumsum([0, *(L * r for r in room)])
    head_start = np.cumsum([0, *heads])

    def of_triangles(field: str) -> np.ndarray:
        return np.concatenate([getattr(top, f"sheet_{field}") for top in tops])

    def of_particles(field: str) -> np.ndarray:
        # topologies without triangles hold nothing, but particles are numbered through
        parts = []
        for top in tops:
            values = getattr(top, f"sheet_{field}")
            blank = np.zeros((top.particle_count, *values.shape[1:]), values.dtype)
            parts.append(values if len(values) or not has_sheets else blank)
        return np.concatenate(parts)

    first = np.cumsum([0, *(len(top.sheet_triangle) for top in tops)])
    edge_first = np.cumsum([0, *(len(top.sheet_edge) for top in tops)])
    links = [len(tops[k].sheet_edge) * L for k in data.group_topology]
    link_start = np.cumsum([0, *links])
    for name, values in (
        ("sheets.first", first),
        ("sheets.grid", grid),
        ("sheets.owner", of_particles("owner")),
        ("cells.head_start", head_start[:-1]),
        ("cells.list_start", list_start[:-1]),
        ("cells.capacity", room),
        ("sheets.edge_first", edge_first),
        ("cells.link_start", link_start[:-1]),
    ):
        data.add_constant(name, np.asarray(values), wp.int32, np.int32)
    data.add_constant("sheets.triangle", of_triangles("triangle"), wp.vec3i, np.int32)
    data.add_constant("sheets.edge", of_triangles("edge"), wp.vec2i, np.int32)
    data.add_constant("sheets.friction", of_triangles("friction"), t.S, number)
    data.add_constant("sheets.rest", of_particles("rest"), t.R3, number)
    exempt_first, exempt = _exempt(data, of_particles)
    data.add_constant("sheets.exempt_first", exempt_first, wp.int32, np.int32)
    data.add_constant("sheets.exempt", exempt, wp.int32, np.int32)
    for name in ("skin", "edge_gap"):
        data.add_constant(f"sheets.{name}", of_particles(name), t.S, number)
    cell = np.array([top.sheet_cell for top in tops])
    widest = np.array([top.sheet_skin.max(initial=0.0) for top in tops])
    edge_widest = np.array([top.sheet_edge_gap.max(initial=0.0) for top in tops])
    data.add_constant("sheets.edge_widest", edge_widest, t.S, number)
    data.add_constant("sheets.cell", cell, t.S, number)
    data.add_constant("sheets.widest", widest, t.S, number)
    particles = int(data.group_particle[-1]) if has_sheets else 0
    slots = data.group_count * L
    edge_room = int(list_start[-1]) if data.has_edges else 0
    for name, count in (
        ("head", int(head_start[-1])),
        ("key", particles * L),
        ("particle", int(list_start[-1])),
        ("face", int(list_start[-1])),
        ("count", slots),
        ("met", slots),
        ("edge_key", int(link_start[-1])),
        ("edge_moved", int(link_start[-1])),
        ("edge_count", slots),
        ("edge_a", edge_room),
        ("edge_b", edge_room),
        ("moved", particles * L),
        ("stamp", particles * L),
    ):
        data.add_array(f"cells.{name}", count, wp.int32, (), np.int32)
    data.add_array("cells.gap", int(list_start[-1]), t.S, (), number)
    data.add_array("cells.edge_gap", edge_room, t.S, (), number)
    for name, count in (
        ("edge_ball", int(link_start[-1])),
        ("edge_sorted", int(link_start[-1])),
        ("place", particles * L),
        ("sorted", particles * L),
    ):
        data.add_array(f"cells.{name}", count, t.V4, (4,), number)
    data.add_array("cells.xr", particles, t.V3, (3, L), number)
    data.add_array("cells.slack", particles, t.V, (L,), number)


def _exempt(
    data: PackedWorlds, of_particles: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Of every particle, which others never touch triangles that it is a corner of.

    Those of its own object nearer in the rest shape than their exclusion; local numbers, and where
    each particle's slice of them starts.
    """
    rest = of_particles("rest").astype(data.number)
    exclusion = of_particles("exclusion").astype(data.number)
    owner = of_particles("owner")
    exempt, counts, start = [], [], 0
    for top in data.topologies:
        rows = slice(start, start + top.particle_count)
        start += top.particle_count
        if not len(top.sheet_triangle):
            counts.append(np.zeros(top.particle_count if data.has_sheets else 0, int))
            continue
        tree = cKDTree(rest[rows])
        near = tree.query_pairs(1.001 * float(exclusion[rows].max()), output_type="ndarray")
        self_ = np.arange(top.particle_count)
        corner = np.concatenate([near[:, 0], near[:, 1], self_])
        other = np.concatenate([near[:, 1], near[:, 0], self_])
        d = rest[rows][other] - rest[rows][corner]
        close = (d * d).sum(axis=1) <= exclusion[rows][other] ** 2
        keep = close & (owner[rows][corner] == owner[rows][other])
        order = np.lexsort((other[keep], corner[keep]))
        exempt.append(other[keep][order])
        counts.append(np.bincount(corner[keep], minlength=top.particle_count))
    return np.cumsum([0, *np.concatenate(counts)]), np.concatenate([np.zeros(0, int), *exempt])
