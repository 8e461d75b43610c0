"""Threads share the groups of a launch: the same bits, and errors surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fixtures.bag_scenes import bag_solver
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import new_builder

from warp_deform.errors import InputError
from warp_deform.objects import CableConfig, add_cable, cable_line
from warp_deform.rollout import DifferentiableRollout, GripPath, rollout
from warp_deform.rollout.rollouts import prepare
from warp_deform.solver import SolverFusedXPBD
from warp_deform.xpbd import group_launch

SHEET = replace(SMALL, edge_contact=0.2)
WORLDS = 5
"""Groups of one lane: no multiple of any number of threads below."""
Make = Callable[..., SolverFusedXPBD]


def cables(worlds: int, **options: object) -> SolverFusedXPBD:
    config = CableConfig(beads=12)
    one, builder = new_builder(), new_builder()
    add_cable(one, config, cable_line(config, (0.4, 0.0), (0.6, 0.0)))
    builder.replicate(one, worlds)
    return SolverFusedXPBD(builder.finalize(device="cpu"), **options)


def sheets(worlds: int, **options: object) -> SolverFusedXPBD:
    return cloth_solver(SHEET, worlds=worlds, **options)[0]


def bags(worlds: int, **options: object) -> SolverFusedXPBD:
    return bag_solver(worlds, **options)[0]


def led(solver: SolverFusedXPBD, seconds: float) -> dict[int, GripPath]:
    """Start every world otherwise, and lead one of its particles along a path of its own."""
    paths = {}
    for w in range(solver.data.world_count):
        rng = np.random.default_rng(w)
        x = solver.data.lane("particles.x", w)
        x += rng.normal(0, 5e-4, x.shape)
        x[:, 2] += 5e-3
        knots = x[w].astype(float) + np.array([[0, 0, 0], rng.uniform(-0.03, 0.03, 3)])
        paths[w] = GripPath(seconds * np.array([0, 0.4 + 0.1 * w % 5]), knots, particle=w)
    return paths


def differentiated(solver: SolverFusedXPBD, seconds: float) -> list[bytes]:
    """Where all worlds end, and all derivatives of a loss."""
    worlds, run = range(solver.data.world_count), DifferentiableRollout(solver)
    ends = run.forward(worlds, [seconds / 3, seconds], paths=led(solver, seconds))
    weights = np.random.default_rng(9).normal(size=ends.shape)
    gradients = vars(run.backward(weights, 0.1 * weights))
    assert np.abs(gradients["positions"]).max(axis=(1, 2)).min() > 0
    values = [ends, run.velocities, *gradients.values()]
    return [np.asarray(list(v.values()) if isinstance(v, dict) else v).tobytes() for v in values]


def played(solver: SolverFusedXPBD, seconds: float) -> list[bytes]:
    """Where all worlds end, and what the guards saw; how long a world runs is its own affair."""
    worlds = range(solver.data.world_count)
    paths = led(solver, seconds)
    most = {w: seconds * (0.5 + 0.1 * (w % 6)) for w in worlds}
    done = rollout(solver, worlds, paths=paths, max_seconds=most, record=seconds / 4)
    states = [solver.particle_q(w).tobytes() + solver.particle_qd(w).tobytes() for w in worlds]
    frames = [done[w].frames.particle_q.tobytes() for w in worlds]
    return [*states, *frames, repr([done[w].watch for w in worlds]).encode()]


@pytest.mark.parametrize(
    ("make", "seconds"),
    [(cables, 0.2), (sheets, 0.1), (bags, 0.02)],
    ids=["cable", "fabric", "bag"],
)
def test_threads_change_no_bit_of_states_and_derivatives(
    monkeypatch: pytest.MonkeyPatch, make: Make, seconds: float
) -> None:
    monkeypatch.setattr(group_launch, "LEAST", 0)
    results = []
    for threads in (1, 2, 3):
        options = {"lanes": 1, "precision": "float64", "threads": threads}
        assert make(WORLDS, **options).data.group_count == WORLDS
        results.append(
            played(make(WORLDS, **options), seconds)
            + differentiated(make(WORLDS, **options), seconds)
        )
    assert results[1] == results[0]
    assert results[2] == results[0]
    assert len(set(results[0][:WORLDS])) == WORLDS


def test_groups_of_many_lanes_keep_their_bits_on_threads() -> None:
    alone, shared = sheets(11, threads=1), sheets(11, threads=2)
    assert alone.data.group_count == shared.data.group_count == 2
    assert played(shared, 0.05) == played(alone, 0.05)


def test_an_error_in_one_part_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = cables(40, threads=2)
    solver.run(2)
    part = solver._launch._parts[-1]

    def fail() -> None:
        raise MemoryError("in one part")

    monkeypatch.setattr(part, "launch", fail)
    with pytest.raises(MemoryError, match="in one part"):
        solver.run(2)
    monkeypatch.undo()
    assert all(v.steps == 2 for v in solver.run(2))


def test_groups_write_nothing_that_another_one_writes() -> None:
    for make in (cables, sheets, bags):
        solver = make(3, lanes=1, precision="float64", threads=3)
        views = solver.data.views
        prepare(solver, range(3), paths=led(solver, 0.02), max_seconds=0.02)
        solver.run(1)
        prepare(solver, range(3), paths=led(solver, 0.02), max_seconds=0.02)
        before = {name: view.copy() for name, view in views.items()}
        written: dict[str, np.ndarray] = {}
        assert len(solver._launch._parts) == 3
        for part in solver._launch._parts:
            part.launch()
            for name, view in views.items():
                changed = view.view(np.uint8) != before[name].view(np.uint8)
                written[name] = written.get(name, 0) + changed.astype(int)
                view[...] = before[name]
        assert max(count.max() for count in written.values()) == 1
        assert written["particles.x"].reshape(3, -1).max(axis=1).tolist() == [1, 1, 1]


@pytest.mark.parametrize("threads", [0, -1, 1.5])
def test_what_is_no_number_of_threads_is_refused(threads: float) -> None:
    with pytest.raises(InputError, match="threads"):
        cables(2, threads=threads)
