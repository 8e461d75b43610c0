"""Fabrics for the solver's tests, and what a fold may not do to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from solver_scenes import finalize, new_builder

from warp_deform.objects import (
    BoxConfig,
    CableConfig,
    Cloth,
    ClothConfig,
    add_box,
    add_cable,
    add_cloth,
    cable_line,
    cloth_sheet,
)
from warp_deform.rollout import GripPath
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER

FABRIC = ClothConfig()
SMALL = ClothConfig(rows=6, columns=6, side=0.1)


def cloth_solver(
    cloth: ClothConfig = FABRIC,
    *,
    height: float | None = None,
    worlds: int = 1,
    box: tuple[float, float, float] | None = None,
    config: SolverConfig = CLOTH_SOLVER,
    **options: object,
) -> tuple[SolverFusedXPBD, Cloth]:
    """Worlds with one flat cloth each at the middle of the table, and a 4 cm cube at `box` [m]."""
    one, builder = new_builder(), new_builder()
    handle = add_cloth(one, cloth, cloth_sheet(cloth, (0.5, 0.0), height=height))
    if box is not None:
        add_box(one, BoxConfig(), box)
    builder.replicate(one, worlds)
    return SolverFusedXPBD(builder.finalize(device="cpu"), config, **options), handle


def two_sheets_and_a_cable(
    config: SolverConfig = CLOTH_SOLVER, *, edge: float = 0.0, **options: object
) -> SolverFusedXPBD:
    """Two sheets above each other and a cable above both; edge: share `edge_contact`."""
    builder = new_builder()
    for height in (0.03, 0.04):
        cloth = replace(SMALL, edge_contact=edge)
        add_cloth(builder, cloth, cloth_sheet(SMALL, (0.5, 0.0), height=height, yaw=height * 30))
    # as light as the sheets: what is much heavier sinks into a layer by some millimetres
    cable = CableConfig(beads=8, mass=0.005)
    beads = np.add(cable_line(cable, (0.46, 0.0), (0.6, 0.02)), [0, 0, 0.05])
    add_cable(builder, cable, beads)
    return finalize(builder, config, **options)


def crumpled(count: int, seed: int = 0, size: float = 0.05) -> np.ndarray:
    """Positions (count, 3) in a box of side `size` [m] above the table: far too close."""
    return np.add(np.random.default_rng(seed).uniform(0, size, (count, 3)), [0.5, 0.0, 0.02])


def fold_path(start: np.ndarray, way: tuple[float, float], *, particle: int = 0) -> GripPath:
    """Lift by 8 cm, carry by `way` [m], lower to a layer above the table, let go."""
    knots = np.array([[0, 0, 0], [0, 0, 0.08], [*way, 0.08], [*way, 0.01]]) + start
    return GripPath(np.array([0, 0.3, 1.0, 1.3]), knots, particle=particle)


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Edges (E, 2) of triangles (T, 3)."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(sides, axis=1), axis=0)


def piercing(x: np.ndarray, faces: np.ndarray) -> int:
    """How many edges pierce a triangle with which they share no corner, exactly (float64)."""
    x = np.asarray(x, dtype=float)
    edges = edges_of(faces)
    start, way = x[edges[:, 0]], x[edges[:, 1]] - x[edges[:, 0]]
    hit = np.zeros(len(edges), bool)
    for face in faces:
        a, b, c = x[face]
        u, v = b - a, c - a
        p = np.cross(way, v)
        det = p @ u
        det = np.where(np.abs(det) > 1e-18, det, np.inf)
        t = start - a
        q = np.cross(t, u)
        first, second, along = (t * p).sum(1) / det, (way * q).sum(1) / det, q @ v / det
        inside = (first >= 0) & (second >= 0) & (first + second <= 1) & (along >= 0) & (along <= 1)
        shared = np.isin(edges, face).any(axis=1)
        hit |= inside & ~shared & np.isfinite(det)
    return int(hit.sum())


def edge_ratios(x: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Length of every edge over that in the rest shape."""
    i, j = edges_of(faces).T
    return np.linalg.norm(x[i] - x[j], axis=1) / np.linalg.norm(rest[i] - rest[j], axis=1)
