"""What is free falls and turns as in a vacuum; what lies on something comes to rest, and only that.

A curtain, a throw and a fall against closed forms; momentum against its sum; sleep against what
must wake it.
"""

from __future__ import annotations

from dataclasses import replace

import newton
import numpy as np
import pytest
from fixtures.bag_scenes import BAG, BAG_SOLVER, bag_solver, throw
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import (
    LOOSE,
    G,
    finalize,
    new_builder,
    positions,
    set_gravity,
    velocities,
)

from warp_deform.errors import InputError
from warp_deform.objects import (
    BoxConfig,
    CableConfig,
    ClothConfig,
    add_bag,
    add_box,
    add_cable,
    add_cloth,
    cable_line,
    cloth_sheet,
)
from warp_deform.rollout import DifferentiableRollout, GripPath, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.cable_physics import CABLE_SOLVER
from warp_deform.tasks.cloth_physics import FABRIC, FABRIC_SOLVER
from warp_deform.xpbd.springs.viscosity import DAMP_EVERY

DT = 1 / 1200
SHELL = ClothConfig(
    mass=0.41,  # as heavy as the bag's shell by area
    structural_stiffness=BAG.structural_stiffness,
    shear_stiffness=BAG.shear_stiffness,
    bend_stiffness=BAG.bend_stiffness,
    edge_contact=BAG.edge_contact,
)
SOLVERS = {
    "cable": CABLE_SOLVER,
    "fabric": FABRIC_SOLVER,
    "bag": BAG_SOLVER,
    "box": BlockNotarget.solver,
}


def aloft(kind: str, height: float, config: SolverConfig, **options: object) -> SolverFusedXPBD:
    """One thing of a kind in the air."""
    builder = new_builder()
    if kind == "cable":
        line = cable_line(CableConfig(), (0.34, 0.0), (0.66, 0.0))
        add_cable(builder, CableConfig(), np.add(line, [0, 0, height]))
    elif kind == "fabric":
        add_cloth(builder, FABRIC, cloth_sheet(FABRIC, (0.5, 0.0), height=height))
    elif kind == "bag":
        pose = np.eye(4)
        pose[:3, 3] = 0.5, 0.0, height + 0.1
        add_bag(builder, BAG, pose)
    else:
        add_box(builder, BoxConfig(), (0.5, 0.0, height))
    return finalize(builder, config, **options)


def middle(solver: SolverFusedXPBD) -> np.ndarray:
    """Centre of mass (3,) [m] of a lone thing."""
    if solver.data.has_bodies:
        return solver.data.views["bodies.x"][0].astype(float)
    mass = 1.0 / solver.data.lane("particles.w0", 0)
    return mass @ positions(solver).astype(float) / mass.sum()


def momenta(solver: SolverFusedXPBD) -> tuple[np.ndarray, np.ndarray, float]:
    """Momentum and angular momentum of the particles, and their kinetic energy."""
    mass = 1.0 / solver.data.lane("particles.w0", 0)[:, None]
    x, v = positions(solver), velocities(solver)
    return (mass * v).sum(0), np.cross(x, mass * v).sum(0), float((mass * v * v).sum() / 2)


# -- free


@pytest.mark.parametrize("height", [0.5, 30.0])
@pytest.mark.parametrize("kind", SOLVERS)
def test_what_is_free_falls_with_g_in_the_tasks(kind: str, height: float) -> None:
    solver = aloft(kind, height, SOLVERS[kind], precision="float32")
    before, time = middle(solver), 0.25
    solver.run(round(time / DT))
    fallen = before - middle(solver)
    assert 2 * fallen[2] / time**2 == pytest.approx(G, rel=0.01)
    np.testing.assert_allclose(fallen[:2], 0.0, atol=1e-4)


def test_a_fabric_that_is_thrown_up_comes_down() -> None:
    config = replace(FABRIC_SOLVER, max_speed=1e3, limits=LOOSE)
    solver = aloft("fabric", 0.1, config, precision="float32")
    solver.data.lane("particles.v", 0)[:] = 0.0, 0.0, 12.0
    for time in np.arange(1, 6) * 0.4:
        solver.run(round(0.4 / DT))
        flight = 0.1 + 12.0 * time - G / 2 * time * (time + DT)
        assert middle(solver)[2] == pytest.approx(flight, rel=0.01)
    solver.run(round(1.5 / DT))
    assert middle(solver)[2] == pytest.approx(FABRIC.radius, abs=2e-3)


@pytest.mark.parametrize("kind", ["fabric", "bag"])
def test_viscosity_conserves_both_momenta_of_what_is_free(kind: str) -> None:
    """A visit changes velocities alone, so what it changes is what the same substep lacks without.

    The same of a piece that turns as a whole is nothing.
    """
    ends, rng = {}, np.random.default_rng(1)
    moves = rng.normal(0, 0.3, positions(aloft(kind, 1.0, BAG_SOLVER)).shape)
    for name, viscosity, random in (
        ("off", 0.0, 1.0), ("on", 60.0, 1.0), ("turning", 60.0, 0.0), ("turning off", 0.0, 0.0)
    ):  # fmt: skip
        config = replace(SOLVERS[kind], viscosity=viscosity, sleep_speed=0.0, max_speed=1e3)
        solver = aloft(kind, 1.0, config)
        set_gravity(solver, 0, np.zeros(3))
        turn = np.cross([1.0, -2.0, 3.0], positions(solver) - middle(solver))
        solver.data.lane("particles.v", 0)[:] = [0.5, 1.0, 2.0] + turn + random * moves
        solver.run(1)
        ends[name] = momenta(solver)
    for name in ("on", "turning"):
        without = ends["off" if name == "on" else "turning off"]
        np.testing.assert_allclose(ends[name][0], without[0], rtol=1e-12)
        np.testing.assert_allclose(ends[name][1], without[1], rtol=1e-10, atol=1e-12)
    assert ends["on"][2] < 0.99 * ends["off"][2]
    # springs have answered the turn by a hair's breadth
    assert ends["turning"][2] == pytest.approx(ends["turning off"][2], rel=1e-4)


@pytest.mark.parametrize("kind", ["fabric", "bag"])
def test_a_viscosity_that_would_shake_a_fabric_apart_is_refused(kind: str) -> None:
    """What is just below the limit calms every motion; a hundredth above it the solver says no."""
    config = replace(SOLVERS[kind], sleep_speed=0.0, max_speed=1e3, limits=LOOSE)
    with pytest.raises(InputError, match=r"at most$") as refused:
        aloft(kind, 1.0, replace(config, viscosity=1e3))
    most = float(str(refused.value).split()[-3].removesuffix("/s"))
    with pytest.raises(InputError):
        aloft(kind, 1.0, replace(config, viscosity=1.01 * most))
    solver = aloft(kind, 1.0, replace(config, viscosity=0.99 * most))
    with pytest.raises(InputError):
        solver.run(1, dt=2 * DT)
    set_gravity(solver, 0, np.zeros(3))
    moves = np.random.default_rng(3).normal(0, 0.1, positions(solver).shape)
    solver.data.lane("particles.v", 0)[:] = moves
    energies = [momenta(solver)[2]]
    for _ in range(5):
        solver.run(round(0.2 / DT))
        energies.append(momenta(solver)[2])
    assert energies[-1] < 0.05 * energies[0] and max(energies) == energies[0]


@pytest.mark.parametrize("kind", ["fabric", "bag"])
def test_viscosity_is_visited_as_often_as_the_mesh_asks_for(kind: str) -> None:
    """Rarely in the tasks, at every substep where that is so long or the viscosity so high."""
    config = replace(SOLVERS[kind], sleep_speed=0.0, max_speed=1e3, limits=LOOSE)
    usual = aloft(kind, 1.0, config)
    assert usual.damp_every() == usual.damp_every(60) == DAMP_EVERY
    assert usual.damp_every(50) == 2, "a launch that others follow has its share"
    # the peers' coarsest setting, with the tasks' viscosity
    assert 1 <= usual.damp_every(dt=1 / 120) < DAMP_EVERY
    thick = aloft(kind, 1.0, replace(config, viscosity=8 * config.viscosity))
    assert 1 <= thick.damp_every() < DAMP_EVERY
    set_gravity(thick, 0, np.zeros(3))
    moves = np.random.default_rng(3).normal(0, 0.1, positions(thick).shape)
    thick.data.lane("particles.v", 0)[:] = moves
    before = momenta(thick)[2]
    thick.run(round(0.2 / DT))
    assert momenta(thick)[2] < 0.5 * before
    recorded = DifferentiableRollout(thick).recorder._settings
    assert recorded.damp_every == thick.damp_every() and recorded.viscous > 0


def test_nothing_sleeps_where_there_is_no_weight() -> None:
    solver = aloft("fabric", 1.0, FABRIC_SOLVER, precision="float32")
    set_gravity(solver, 0, np.zeros(3))
    solver.data.lane("particles.v", 0)[:, 0] = 2e-3
    before = middle(solver)
    solver.run(round(2.0 / DT))
    np.testing.assert_allclose(middle(solver) - before, [4e-3, 0, 0], atol=1e-5)


# -- held


@pytest.mark.parametrize(
    ("cloth", "config", "degrees"),
    [(FABRIC, FABRIC_SOLVER, 5.0), (SHELL, BAG_SOLVER, 10.0)],
    ids=["fabric", "shell"],
)
def test_a_curtain_let_go_askew_hangs_straight_and_still(cloth, config, degrees) -> None:
    builder, angle = new_builder(), np.radians(degrees)
    flat = cloth_sheet(cloth, (0.5, 0.0), height=0.0)
    below = flat[:, 1].max() - flat[:, 1]
    hung = [flat[:, 0], below * np.sin(angle), 0.6 - below * np.cos(angle)]
    add_cloth(builder, cloth, np.column_stack(hung))
    solver = finalize(builder, config, precision="float32")
    rail = np.arange(len(flat) - cloth.columns, len(flat))
    for name in ("w", "w0"):
        solver.data.lane(f"particles.{name}", 0)[rail] = 0.0
    seen = []
    for _ in range(90):
        solver.run(60)
        x = positions(solver).astype(float)
        way = x[: cloth.columns].mean(0) - x[rail].mean(0)
        seen.append(np.degrees(np.arctan2(way[1], -way[2])))
    # it swings: through the vertical within the first half second, and less and less
    assert min(seen[:12]) < -0.1 * degrees
    assert np.abs(seen[80:]).max() < 0.5
    assert not solver.data.lane("particles.still", 0).any(), "nothing that is pinned sleeps"


# -- at rest


def settled_sheet(**options: object) -> SolverFusedXPBD:
    """A fabric asleep on the table, or on a box that stands there."""
    solver, _ = cloth_solver(SMALL, config=FABRIC_SOLVER, **options)
    rollout(solver, [0], min_seconds=1.5, max_seconds=1.5)
    assert (solver.data.lane("particles.still", 0) > FABRIC_SOLVER.sleep_seconds).all()
    return solver


def test_bags_at_rest_stay_where_they_are() -> None:
    solver, _ = bag_solver(8, lanes=8)
    pushes = {w: (throw(solver, w, 5000 + w),) for w in range(8)}
    result = rollout(solver, range(8), pushes=pushes, min_seconds=0.2, max_seconds=4.2)
    assert all(r.at_rest for r in result.values())
    before = [solver.particle_q(w) for w in range(8)]
    rollout(solver, range(8), min_seconds=1.5, max_seconds=1.5)
    for w in range(8):
        moved = np.linalg.norm(solver.particle_q(w) - before[w], axis=1)
        assert moved.max() < 3e-3
        assert not solver.particle_qd(w).any()


def test_a_sleeper_falls_when_what_carries_it_is_taken_away() -> None:
    solver = settled_sheet(height=0.046, box=(0.5, 0.0, 0.02))
    before = positions(solver)
    assert before[:, 2].max() > 0.04
    pose = solver.body_q(0)
    pose[0, :3] = 0.5, 0.4, 0.02
    solver.data.set_bodies(0, pose)
    solver.run(round(0.05 / DT))
    fallen = (before - positions(solver))[:, 2]
    over = np.abs(before[:, :2] - [0.5, 0.0]).max(axis=1) < 0.015
    np.testing.assert_allclose(fallen[over], G / 2 * 0.05**2, rtol=0.1)


def test_a_sleeper_wakes_when_it_is_gripped_and_when_it_is_struck() -> None:
    solver = settled_sheet()
    start = positions(solver)[0].astype(float)
    path = GripPath(np.array([0, 0.5]), start + np.array([[0, 0, 0], [0, 0, 0.02]]), particle=0)
    rollout(solver, [0], paths={0: path}, max_seconds=0.1)
    assert not solver.data.lane("particles.still", 0).any()
    solver = settled_sheet(box=(0.53, 0.0, 0.1))
    struck = solver.data.lane("particles.still", 0)
    pose = solver.body_q(0)
    pose[0, :3] = 0.5, 0.0, 0.1
    solver.data.set_bodies(0, pose)
    awake = []
    for _ in range(40):
        solver.run(6)
        awake.append((struck < 0.1).any())
    assert not awake[10] and any(awake), "in the air the box wakes nothing"


def test_a_sleeper_wakes_when_the_physics_of_its_world_change() -> None:
    solver = settled_sheet()
    solver.set_world(0, table_friction=FABRIC_SOLVER.table_friction)
    assert solver.data.lane("particles.still", 0).all(), "that is what it was"
    solver.set_world(0, table_friction=0.1)
    assert not solver.data.lane("particles.still", 0).any()
    solver = settled_sheet()
    solver.model.gravity.assign(np.float32([[6.0, 0.0, -9.0]]))
    solver.notify_model_changed(int(newton.ModelFlags.MODEL_PROPERTIES))
    before = middle(solver)
    solver.run(round(0.2 / DT))
    # it slides by what the table's friction leaves: 6 - 0.5 * 9 m/s^2
    assert (middle(solver) - before)[0] == pytest.approx(1.5 / 2 * 0.2**2, rel=0.1)


def test_a_slow_grip_drags_a_whole_sleeping_fabric() -> None:
    """At 4 mm/s, slower than the sleep speed: what is held does not sleep."""
    solver = settled_sheet()
    start = positions(solver).astype(float)
    knots = start[0] + np.array([[0, 0, 0], [-0.02, 0, 0.0]])
    rollout(
        solver, [0], paths={0: GripPath(np.array([0, 5.0]), knots, particle=0)}, max_seconds=5.0
    )
    assert positions(solver)[0, 0] - start[0, 0] == pytest.approx(-0.02, abs=1e-3)
    assert np.median(positions(solver)[:, 0] - start[:, 0]) < -0.008
    assert solver.data.lane("particles.still", 0).max() < 2 * DT, "let go at the end"


# -- what sleep remembers


def test_steps_in_a_row_fall_asleep_and_another_state_wakes() -> None:
    solver, _ = cloth_solver(SMALL, config=FABRIC_SOLVER)
    state, after = solver.model.state(), solver.model.state()
    for _ in range(60):
        solver.step(state, after, None, None, 1 / 60)
        state, after = after, state
    still = solver.data.lane("particles.still", 0)
    assert (still > FABRIC_SOLVER.sleep_seconds).all()
    quick = state.particle_qd.numpy()
    quick[:, 0] = 3e-3
    state.particle_qd.assign(quick)
    solver.step(state, after, None, None, 1 / 60)
    assert (still < 0.02).all()


def test_a_rollout_that_falls_asleep_is_replayed_to_the_same_bits() -> None:
    found = []
    for storage in ("full", "replay"):
        solver, _ = cloth_solver(SMALL, height=0.01, config=FABRIC_SOLVER, precision="float64")
        run = DifferentiableRollout(solver, storage=storage)
        end = run.forward([0], [0.2, 0.45])
        assert (solver.data.lane("particles.still", 0) > FABRIC_SOLVER.sleep_seconds).any()
        by = run.backward(np.random.default_rng(0).normal(size=end.shape))
        found.append((end, by.positions, by.velocities, by.fired))
    other, _ = cloth_solver(SMALL, height=0.01, config=FABRIC_SOLVER, precision="float64")
    other.run(round(0.45 / DT))
    np.testing.assert_array_equal(positions(other), found[0][0][0, -1])
    for full, replayed in zip(*found, strict=True):
        np.testing.assert_array_equal(full, replayed)
