"""Layers of fabric that are pressed on the table stay apart, and what has crossed is led back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.bag_scenes import BAG, bag_solver, pierced, pull, throw
from fixtures.cloth_scenes import SMALL, cloth_solver, edges_of, fold_path
from fixtures.solver_scenes import finalize, new_builder

from warp_deform.objects import Push, add_cloth, cloth_sheet
from warp_deform.rollout import rollout
from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC, FABRIC_SOLVER


def two_layers() -> tuple[SolverFusedXPBD, float]:
    """A sheet on the table and one above it, half a cell aside; how far apart they touch [m]."""
    builder = new_builder()
    sheet = replace(SMALL, edge_contact=0.2)
    h = sheet.layer_distance(sheet.spacing)
    for layer in range(2):
        middle = 0.5 + 0.4 * layer * sheet.spacing, 0.3 * layer * sheet.spacing
        add_cloth(builder, sheet, cloth_sheet(sheet, middle, height=sheet.radius + layer * h))
    return finalize(
        builder, replace(FABRIC_SOLVER, sleep_speed=0.0), lanes=8, precision="float32"
    ), h


@pytest.mark.parametrize("acceleration", [1000.0, 4000.0])
def test_what_presses_a_layer_onto_the_one_below_does_not_go_through_it(acceleration: float):
    solver, h = two_layers()
    count = SMALL.rows * SMALL.columns
    middle = count + count // 2 + SMALL.columns // 2
    rollout(solver, [0], min_seconds=0.2, max_seconds=0.2)
    push = Push(middle, np.array([0.0, 0.0, -acceleration]), 0.2)
    frames = rollout(
        solver, [0], pushes={0: (push,)}, min_seconds=0.2, max_seconds=0.2, record=0.01
    )[0].frames
    lowest = frames.particle_q[:, middle, 2].min() - SMALL.radius
    assert lowest > 0.9 * h


def folded(worlds: int, folds: int, seed: int) -> list[int]:
    """Edges that pierce the task's fabric after each of some random folds of each sheet."""
    solver, cloth = cloth_solver(FABRIC, worlds=worlds, lanes=8, config=FABRIC_SOLVER)
    rng, counts = np.random.default_rng(seed), []
    for _ in range(folds):
        paths = {}
        for w in range(worlds):
            x = solver.particle_q(w).astype(float)
            particle = int(rng.integers(len(x)))
            way = rng.normal(0, 0.04, 2) + 1.2 * (x.mean(axis=0) - x[particle])[:2]
            paths[w] = fold_path(x[particle], tuple(way), particle=particle)
        rollout(
            solver, range(worlds), paths=paths, min_seconds=0.3, max_seconds=4.0, calm_after=0.2
        )
        counts += [pierced(solver.particle_q(w), cloth.faces) for w in range(worlds)]
    return counts


def test_random_folds_of_the_fabric_of_the_tasks_hardly_pierce_it():
    counts = np.array(folded(16, 4, seed=11)) / 261
    assert counts.mean() <= 0.001 and counts.max() <= 0.01


def test_thrown_and_pulled_bags_hardly_pierce_themselves():
    solver, (bag,) = bag_solver(8, lanes=8)
    edges, counts = len(edges_of(bag.faces)), []
    pushes = {w: (throw(solver, w, 5000 + w),) for w in range(8)}
    rollout(solver, range(8), pushes=pushes, min_seconds=0.2, max_seconds=4.2)
    for _ in range(3):
        paths = {w: pull(solver.particle_q(w), bag.ring, BAG.opening_radius) for w in range(8)}
        rollout(solver, range(8), paths=paths, min_seconds=0.1, max_seconds=5.0)
        counts += [pierced(solver.particle_q(w), bag.faces) / edges for w in range(8)]
    assert np.mean(counts) <= 0.001 and np.max(counts) <= 0.02
