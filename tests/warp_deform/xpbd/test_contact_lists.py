"""The lists of near pairs of fabrics, against brute force: in crumples and during folds."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from fixtures.cloth_scenes import cloth_solver, crumpled, fold_path, two_sheets_and_a_cable
from fixtures.solver_scenes import positions

from warp_deform.objects import ClothConfig
from warp_deform.rollout import rollout
from warp_deform.solver import SolverFusedXPBD


def listed(solver: SolverFusedXPBD, world: int = 0) -> set[tuple[int, int]]:
    """Pairs (particle, triangle) in the list of a world."""
    views, (group, lane) = solver.data.views, divmod(solver.data.slot[world], solver.data.lanes)
    start = views["cells.list_start"][group] + lane * views["cells.capacity"][group]
    rows = slice(start, start + views["cells.count"][solver.data.slot[world]])
    return set(
        zip(views["cells.particle"][rows].tolist(), views["cells.face"][rows].tolist(), strict=True)
    )


def near(solver: SolverFusedXPBD, x: np.ndarray, world: int = 0) -> set[tuple[int, int]]:
    """The same by brute force, with another library's closest points."""
    top = solver.data.topologies[0]
    found = set()
    for t, tri in enumerate(top.sheet_triangle):
        corners = np.broadcast_to(x[tri].astype(float), (len(x), 3, 3))
        distance = np.linalg.norm(
            trimesh.triangles.closest_point(corners, x.astype(float)) - x, axis=1
        )
        apart = np.linalg.norm(top.sheet_rest[:, None] - top.sheet_rest[tri], axis=2).min(axis=1)
        own = top.sheet_owner == top.sheet_owner[tri[0]]
        slack = solver.data.lane("cells.slack", world)
        reach = top.sheet_skin + top.sheet_skin[tri[0]] + slack + slack[tri].max()
        hits = (distance < reach) & (~own | (apart > top.sheet_exclusion))
        found |= {(int(i), t) for i in np.flatnonzero(hits)}
    return found


def listed_edges(solver: SolverFusedXPBD, world: int = 0) -> set[frozenset[int]]:
    """Pairs of edges in the list of a world."""
    views, (group, lane) = solver.data.views, divmod(solver.data.slot[world], solver.data.lanes)
    start = views["cells.list_start"][group] + lane * views["cells.capacity"][group]
    rows = slice(start, start + views["cells.edge_count"][solver.data.slot[world]])
    pairs = np.stack([views["cells.edge_a"][rows], views["cells.edge_b"][rows]], axis=1).tolist()
    assert len({frozenset(p) for p in pairs}) == len(pairs), "no pair is listed twice"
    return {frozenset(p) for p in pairs}


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances (n,) of segments a-b and c-d: of lines where these meet inside, else at an end."""

    def to_segment(p, start, end):
        way = end - start
        share = np.clip(((p - start) * way).sum(1) / (way * way).sum(1), 0, 1)
        return np.linalg.norm(p - start - share[:, None] * way, axis=1)

    ends = [to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)]
    normal = np.cross(b - a, d - c)
    square = np.maximum((normal * normal).sum(1), 1e-30)
    u = (np.cross(c - a, d - c) * normal).sum(1) / square
    v = (np.cross(c - a, b - a) * normal).sum(1) / square
    inside = (u > 0) & (u < 1) & (v > 0) & (v < 1)
    lines = np.abs(((a - c) * normal).sum(1)) / np.sqrt(square)
    return np.minimum(np.min(ends, axis=0), np.where(inside, lines, np.inf))


def near_edges(solver: SolverFusedXPBD, x: np.ndarray, slack: np.ndarray) -> set[frozenset[int]]:
    """Pairs of edges that are nearer than touching distance and slack, by brute force."""
    top = solver.data.topologies[0]
    edges = top.sheet_edge
    i, j = np.triu_indices(len(edges), 1)
    apart = (edges[i][:, :, None] != edges[j][:, None]).all(axis=(1, 2))
    i, j = i[apart], j[apart]
    e, f = edges[i], edges[j]
    x = x.astype(float)
    gap = (top.sheet_edge_gap[e[:, 0]] + top.sheet_edge_gap[f[:, 0]]) / 2
    distance = segment_distance(x[e[:, 0]], x[e[:, 1]], x[f[:, 0]], x[f[:, 1]])
    hits = distance < gap + slack[e].max(axis=1) + slack[f].max(axis=1)
    return {frozenset(p) for p in zip(i[hits].tolist(), j[hits].tolist(), strict=True)}


@pytest.mark.parametrize("seed", range(3))
def test_the_list_is_what_is_near(seed):
    solver = two_sheets_and_a_cable(pairs_per_particle=500)
    x = solver.data.lane("particles.x", 0)
    x[:] = crumpled(len(x), seed)
    solver.run(1)
    # listed where the first substep predicted the particles
    expected = near(solver, solver.data.lane("cells.xr", 0))
    assert len(expected) > 500
    assert listed(solver) == expected


@pytest.mark.parametrize("seed", range(3))
def test_the_list_of_edges_is_what_is_near(seed):
    solver = two_sheets_and_a_cable(edge=1.0, pairs_per_particle=1000)
    x = solver.data.lane("particles.x", 0)
    x[:] = crumpled(len(x), seed)
    solver.run(1)
    slack = solver.data.lane("cells.slack", 0)
    expected = near_edges(solver, solver.data.lane("cells.xr", 0), slack)
    assert len(expected) > 500
    assert listed_edges(solver) == expected


@pytest.mark.parametrize("lanes", [1, 8])
def test_lists_that_are_kept_up_to_date_are_what_lists_made_anew_would_be(lanes):
    cloth = ClothConfig(rows=12, columns=12, edge_contact=1.0)
    solver, _ = cloth_solver(cloth, worlds=lanes, lanes=lanes, pairs_per_particle=400)
    world, seen = lanes - 1, [0, 0]
    for steps in (700, 900, 1100, 1300, 1500, 1560):
        solver.data.reset()
        start = solver.data.lane("particles.x", world)[0].astype(float)
        path = fold_path(start, (0.11, 0.13))
        rollout(solver, [world], paths={world: path}, max_seconds=(steps - 0.5) * solver.config.dt)
        place = solver.data.lane("cells.xr", world)
        slack = solver.data.lane("cells.slack", world)
        assert slack.max() > 2 * slack.min(), "what is carried has more slack than what lies"
        far = np.linalg.norm(solver.data.lane("particles.x", world) - place, axis=1) - slack
        assert (far < 0.001).all()
        assert listed(solver, world) == near(solver, place, world)
        assert listed_edges(solver, world) == near_edges(solver, place, slack)
        seen[0] += len(listed(solver, world))
        seen[1] += len(listed_edges(solver, world))
    assert min(seen) > 100


def test_no_near_pair_is_ever_missing():
    solver = two_sheets_and_a_cable(precision="float32")
    seen = 0
    for _ in range(40):
        solver.run(7)
        x, xr = positions(solver), solver.data.lane("cells.xr", 0)
        # at the end of a substep its corrections come on top of what the list allows for
        slack = solver.data.lane("cells.slack", 0)
        assert (np.linalg.norm(x - xr, axis=1) < slack + 0.001).all()
        top = solver.data.topologies[0]
        tight = {
            (i, t)
            for i, t in near(solver, x)
            if distance(x, i, top.sheet_triangle[t])
            < top.sheet_skin[i] + top.sheet_skin[top.sheet_triangle[t][0]]
        }
        seen += len(tight)
        assert tight <= listed(solver)
    assert seen > 500


def distance(x: np.ndarray, i: int, tri: np.ndarray) -> float:
    point = x[i : i + 1].astype(float)
    return float(
        np.linalg.norm(trimesh.triangles.closest_point(x[tri][None].astype(float), point) - point)
    )
