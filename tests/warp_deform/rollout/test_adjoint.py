"""The adjoint against finite differences; its bits against storage and lanes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.adjoint_check import DT, PARAMETERS, Check, lift, set_state, state
from fixtures.cloth_scenes import SMALL, two_sheets_and_a_cable
from fixtures.solver_scenes import LOOSE, add_particles, box_solver, finalize, ideal, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import BoxConfig, CableConfig, add_box, add_cable, cable_line
from warp_deform.objects.push import Push
from warp_deform.rollout import DifferentiableRollout, GripPath, rollout, substep_vjp
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

pytestmark = pytest.mark.in_a_row("adjoints")

SHORT = CableConfig(beads=10)
ROLLING = replace(FABRIC_SOLVER, damping=4.0, limits=LOOSE, sleep_speed=0.0, max_speed=1e3)
"""A sheet in air that never sleeps: sleep is a jump, which finite differences would straddle."""


def cable_solver(
    worlds: int = 1, lanes: int = 1, precision: str = "float64", bend: float = 0.0
) -> SolverFusedXPBD:
    cable = replace(SHORT, bend_stiffness=bend)
    one, builder = new_builder(), new_builder()
    add_cable(one, cable, cable_line(cable, (0.4, 0.0), (0.6, 0.0)))
    builder.replicate(one, worlds)
    return SolverFusedXPBD(
        builder.finalize(device="cpu"),
        SolverConfig(damping=1.0, limits=LOOSE),
        lanes=lanes,
        precision=precision,
    )


def heap(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = 0.02 + 0.006 * np.arange(SHORT.beads)
    return np.column_stack([rng.normal(0, 4e-3, (SHORT.beads, 2)), z])


@pytest.fixture(scope="module")
def settled() -> SolverFusedXPBD:
    solver = cable_solver()
    set_state(solver, heap(0), np.zeros((SHORT.beads, 3)))
    rollout(solver, [0], min_seconds=0.4, max_seconds=0.4)
    return solver


def test_a_substep_of_a_settled_heap(settled: SolverFusedXPBD) -> None:
    x, v = state(settled)
    counts = Check(settled).assert_right()
    assert min(counts[k] for k in ("stretch", "contact", "table", "fold_limit")) > 0
    set_state(settled, x, v)


@pytest.mark.parametrize("steps", [3, 9])
def test_waypoints_of_a_grip_and_its_release(settled: SolverFusedXPBD, steps: int) -> None:
    x, v = state(settled)
    counts = Check(settled, steps, lift(x, 3)).assert_right(rounding=30.0)
    assert counts["grip"] == min(steps, 6)
    assert counts.get("release", 0) == (steps == 9)
    set_state(settled, x, v)


def test_bending_and_the_speed_clamp() -> None:
    solver = cable_solver(bend=0.02)
    rng = np.random.default_rng(1)
    line = cable_line(SHORT, (0.4, 0.0), (0.6, 0.0))
    set_state(solver, line + rng.normal(0, 1e-3, line.shape), rng.normal(0, 1.8, line.shape))
    counts = Check(solver).assert_right(rounding=30.0)
    assert counts["bend"] == SHORT.beads - 2
    assert counts["speed_clamp"] > 0


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_substep_of_two_crumpled_sheets_and_a_cable(seed: int) -> None:
    solver = two_sheets_and_a_cable(ROLLING, edge=0.2, lanes=1, precision="float64")
    rng = np.random.default_rng(seed)
    x = solver.particle_q(0)
    x += rng.normal(size=x.shape) * 0.002 * (1 + seed % 3)
    if seed == 5:
        x[:, 2] = 0.4 * x[:, 2] - 0.012
    set_state(solver, x, rng.normal(size=x.shape) * 0.05)
    rollout(solver, [0], min_seconds=5 * DT, max_seconds=5 * DT)
    x, v = state(solver)
    acted = Check(solver).assert_right(rounding=30.0, draws=2)
    assert {"triangle_rim", "strain_limit", "viscosity"} <= set(acted)
    set_state(solver, x, v)
    acted = Check(solver, 2, lift(x, 0, 20.0)).assert_right(rounding=300.0, draws=2)
    assert {"tether", "triangle_face"} <= set(acted)
    assert seed == 1 or acted["edge"] > 0


def test_sleep_passes_nothing_on() -> None:
    solver = two_sheets_and_a_cable(replace(ROLLING, sleep_speed=0.006, wake_speed=1.0),
                                    lanes=1, precision="float64")  # fmt: skip
    sheets = 2 * SMALL.rows * SMALL.columns
    x, _ = state(solver)
    x[:sheets, 2] -= x[:sheets, 2].min() - SMALL.radius  # the lower one lies on the table
    x[sheets // 2 :, 2] += 0.05
    still = solver.data.lane("particles.still", 0)
    set_state(solver, x, np.zeros_like(x))
    solver.data.wake(0)
    still[: sheets // 2] = 1.0
    one = np.ones((1, *x.shape))
    asleep = substep_vjp(solver, [0], one, one)
    assert asleep.counts()["sleep"] == sheets // 2
    assert np.array_equal(asleep.positions[0, : sheets // 2], one[0, : sheets // 2])
    assert not asleep.velocities[0, : sheets // 2].any()
    assert (still[: sheets // 2] > 1.0).all() and (still[sheets // 2 : sheets] < 1.0).all()
    set_state(solver, x, np.zeros_like(x))
    awake = substep_vjp(solver, [0], one, one, sleep=False)
    assert "sleep" not in awake.counts()
    assert np.abs(awake.velocities).min() > 0
    set_state(solver, x, np.zeros_like(x))
    again = substep_vjp(solver, [0], one, one)
    assert again.counts() == asleep.counts(), "the one awake changed nothing for later ones"


def test_pinned_particles_give_numbers() -> None:
    builder = new_builder()
    at = [[0.0, 0.0, 0.1], [0.0, 0.0, 0.11], [0.0, 0.0, 0.105], [0.0, 0.0, 0.11]]
    add_particles(
        builder, at, masses=[0.0, 0.0, 0.1, 0.0], links=[(0, 1, 0.02), (1, 2, 0.01), (1, 3, 0.01)],
        colliding=True,
    )  # fmt: skip
    solver = finalize(builder, ideal(), precision="float32")
    run = DifferentiableRollout(solver)
    run.forward([0], [0.02, 0.05])
    gradients = run.backward(np.ones((1, 2, 4, 3)), np.ones((1, 2, 4, 3)))
    for value in vars(gradients).values():
        if isinstance(value, np.ndarray):
            assert np.isfinite(value).all()
    assert not gradients.inverse_masses[0, [0, 1, 3]].any()


def play(
    solver: SolverFusedXPBD, slots: dict[int, int], storage: str, memory: int = 2**28
) -> dict[int, list[np.ndarray]]:
    """End and derivatives by the world that a slot plays: grips, pushes, rest, several times."""
    paths, pushes = {}, {}
    for slot, seed in slots.items():
        set_state(solver, heap(seed), 0 * heap(seed), slot)
        start = state(solver, slot)[0][0].astype(float)
        if seed % 2:
            knots = start + np.array([[0, 0, 0], [0.03, 0.01 * seed, 0.02], [0.05, 0, -0.01]])
            paths[slot] = GripPath(np.array([0, 0.05, 0.15]), knots, particle=0, lower=(0.1, 0.15))
        else:
            pushes[slot] = (Push(6, np.array([4.0 * seed, 9.0, 20.0]), 0.05),)
    run = DifferentiableRollout(solver, storage=storage, memory=memory)
    worlds = list(slots)
    end = run.forward(worlds, [0.1, 0.25], paths=paths, pushes=pushes, until_rest=True)
    cotangents = np.stack(
        [np.random.default_rng(s).normal(size=(2, SHORT.beads, 3)) for s in slots.values()]
    )
    g = run.backward(cotangents)
    again = run.backward(cotangents)
    out = {}
    for k, (slot, seed) in enumerate(slots.items()):
        out[seed] = [end[k], g.positions[k], g.velocities[k], g.inverse_masses[k], g.fired[k]]
        out[seed] += [getattr(g, name)[k] for name in PARAMETERS]
        assert np.array_equal(again.positions[k], g.positions[k])
        if slot in paths:
            out[seed] += [g.waypoints[slot], g.knot_times[slot], g.knot_rotations[slot]]
    return out


def test_bits_depend_neither_on_storage_nor_on_lanes() -> None:
    together = cable_solver(5, 8, "float32")
    slots = {slot: slot for slot in range(5)}
    full = play(together, slots, "full")
    again = play(together, slots, "replay", memory=2**20)
    alone = cable_solver(1, 1, "float32")
    for seed in slots:
        lone = play(alone, {0: seed}, "replay")[seed]
        for a, b, c in zip(full[seed], again[seed], lone, strict=True):
            assert np.isfinite(a).all()
            assert np.array_equal(a, b) and np.array_equal(a, c)
    plain = cable_solver(5, 8, "float32")
    for slot in slots:
        set_state(plain, heap(slot), 0 * heap(slot), slot)
    rollout(plain, [2, 4], min_seconds=0.1, max_seconds=0.1)
    for slot in (2, 4):
        set_state(together, heap(slot), 0 * heap(slot), slot)
    DifferentiableRollout(together).forward([2, 4], [0.1])
    for slot in (2, 4):
        assert np.array_equal(state(plain, slot), state(together, slot))


def test_states_at_the_times_that_were_asked_for() -> None:
    builder, box = new_builder(), BoxConfig(mass=0.05)
    add_cable(builder, SHORT, cable_line(SHORT, (0.4, 0.0), (0.6, 0.0)))
    add_box(builder, box, (0.5, 0.2, 0.03))
    solver = SolverFusedXPBD(
        builder.finalize(device="cpu"), SolverConfig(damping=1.0, limits=LOOSE), lanes=1
    )
    run = DifferentiableRollout(solver)
    start = [solver.particle_q(0)[None], solver.particle_qd(0)[None]]
    bodies = [b[None] for b in solver.data.body_poses(0)]
    x = run.forward([0], [0.05, 0.1])
    for values, now in (
        (x, solver.particle_q(0)),
        (run.velocities, solver.particle_qd(0)),
        (run.body_poses, solver.body_q(0)),
        (run.body_velocities, solver.body_qd(0)),
    ):
        assert values.shape == (1, 2, *now.shape)
        assert np.array_equal(values[0, 1], now)
    early, poses, twists = run.velocities[0, 0], run.body_poses[0, 0], run.body_velocities[0, 0]
    run.forward(
        [0],
        [0.05],
        positions=start[0],
        velocities=start[1],
        body_poses=bodies[0],
        body_velocities=bodies[1],
    )
    assert np.array_equal(solver.particle_qd(0), early)
    assert np.array_equal(solver.body_q(0), poses) and np.array_equal(solver.body_qd(0), twists)


def test_what_sleeps_on_passes_its_pose_through() -> None:
    solver = box_solver(
        (BoxConfig(mass=0.05), (0, 0, 0.02)), config=SolverConfig(damping=1.0, limits=LOOSE)
    )
    rollout(solver, [0], min_seconds=0.5, max_seconds=0.5)
    run = DifferentiableRollout(solver)
    run.forward([0], [0.1])
    slope = np.array([[[[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0]]]])
    asleep = run.backward(bodies=slope)
    assert asleep.counts() == {"body_sleep": 120}
    assert np.array_equal(asleep.body_poses, slope[:, 0])
    assert not asleep.body_velocities.any()
    # its last velocity is that of the contacts that its sleep undid: these count
    awake = run.backward(bodies=slope, body_velocities=np.ones((1, 1, 1, 6)))
    assert awake.counts().get("body_table", 0) > 0


def test_memory_is_bounded() -> None:
    solver = cable_solver(2, 1, "float32")
    with pytest.raises(InputError, match="allow more memory"):
        play(solver, {0: 0, 1: 1}, "full", memory=100_000)
    play(solver, {0: 0, 1: 1}, "replay", memory=1_000_000)


def test_tapes_are_kept_while_they_fit_and_taped_again_from_there_on() -> None:
    solver = cable_solver(1, 1, "float32")
    found = {}
    for memory in (2**28, 600_000):
        set_state(solver, heap(3), 0 * heap(3))
        run = DifferentiableRollout(solver, memory=memory)
        run.forward([0], [0.2, 0.4])
        kept = [segment.tape is not None for segment in run.recorder._segments]
        found[all(kept)] = run.backward(np.ones((1, 2, SHORT.beads, 3)))
        assert kept[0] and run.recorder.nbytes <= memory
    assert set(found) == {True, False}
    for name in ("positions", "velocities", "inverse_masses", "spring_stiffness", "radii", "fired"):
        assert np.array_equal(getattr(found[True], name), getattr(found[False], name)), name


def test_a_segment_that_takes_more_tape_than_it_was_thought_to_is_cut() -> None:
    solver = cable_solver(1, 1, "float32")
    found = []
    for known in (True, False):
        set_state(solver, heap(3), 0 * heap(3))
        run = DifferentiableRollout(solver, storage="replay")
        run.forward([0], [0.4, 0.41])
        room, segments = run.recorder._room, len(run.recorder._segments)
        assert room.use is not None
        if not known:
            room.use = 0.2 * room.use
        found.append(run.backward(np.ones((1, 2, SHORT.beads, 3))))
        assert (len(run.recorder._segments) > segments) == (not known)
    for name in ("positions", "velocities", "inverse_masses", "spring_stiffness", "radii", "fired"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name)), name


def test_parts_are_left_out_where_they_are_not_asked_for() -> None:
    solver = cable_solver(1, 1, "float32")
    run = DifferentiableRollout(solver)
    set_state(solver, heap(3), 0 * heap(3))
    by = np.ones_like(run.forward([0], [0.1]))
    whole, rest = run.backward(by), run.backward(by, parts=False)
    for name in ("inverse_masses", "radii", "spring_stiffness", "rest_lengths"):
        assert getattr(whole, name).any() and np.isnan(getattr(rest, name)).all()
    for name in ("positions", "velocities", "stiffness", "fired"):
        assert np.array_equal(getattr(whole, name), getattr(rest, name))


def test_what_cannot_be_differentiated_is_refused() -> None:
    solver = cable_solver(2, 1)
    with pytest.raises(InputError, match="storage"):
        DifferentiableRollout(solver, storage="disk")
    run = DifferentiableRollout(solver)
    with pytest.raises(InputError, match="ascending"):
        run.forward([0], [0.2, 0.1])
    with pytest.raises(InputError, match="no parameter 'mass'"):
        run.forward([0], [0.1], parameters={"mass": np.ones(1)})
    with pytest.raises(InputError, match="one topology"):
        run.forward([], [0.1])
