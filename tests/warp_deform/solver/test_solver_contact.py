"""Beads on the table and on each other: friction, rest, collisions, heaps."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.solver_scenes import (
    IDEAL,
    LOOSE,
    G,
    add_particles,
    energy,
    finalize,
    frames,
    ideal,
    new_builder,
    positions,
    set_gravity,
    tilt,
    velocities,
)

from warp_deform.objects import CableConfig, RingConfig, add_cable, cable_line, cable_ring
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverConfig

DT, RADIUS = 1 / 1200, 0.005


def test_a_sliding_bead_stops_after_v2_over_2_mu_g():
    # s = v^2 / (2 mu g); s is short by at most v dt: the table acts in the first substep
    for mu, speed in ((0.2, 0.5), (0.5, 1.0), (0.8, 0.6)):
        builder = new_builder()
        add_particles(builder, [(0, 0, RADIUS)], velocities=[(speed, 0, 0)])
        solver = finalize(builder, ideal(table_friction=mu))
        solver.run(2400)
        stopping = speed**2 / (2 * mu * G)
        assert positions(solver)[0, 0] == pytest.approx(stopping, abs=speed * DT), mu
        assert np.abs(velocities(solver)).max() < 1e-3


def slope(
    ratios: np.ndarray, mu: float, *, steps: int, warm: int = 120
) -> tuple[np.ndarray, np.ndarray]:
    """Mean speed and acceleration down the slope of beads; ratios: tan(angle) / mu."""
    one = new_builder()
    add_particles(one, [(0, 0, RADIUS)])
    builder = new_builder()
    builder.replicate(one, len(ratios))
    solver = finalize(builder, ideal(table_friction=mu), lanes=8)
    for w, ratio in enumerate(ratios):
        set_gravity(solver, w, tilt(np.arctan(mu * ratio)))
    solver.run(warm)
    x = np.array([positions(solver, w)[0, 0] for w in range(len(ratios))])
    v = np.array([velocities(solver, w)[0, 0] for w in range(len(ratios))])
    solver.run(steps)
    x1 = np.array([positions(solver, w)[0, 0] for w in range(len(ratios))])
    v1 = np.array([velocities(solver, w)[0, 0] for w in range(len(ratios))])
    return (x1 - x) / (steps * DT), (v1 - v) / (steps * DT)


@pytest.mark.parametrize("mu", [0.3, 0.5, 0.8])
def test_a_bead_slides_above_the_friction_angle(mu):
    # a = g (sin - mu cos); friction is full once a substep's slip is far above mu g cos dt^2
    ratios = np.array([1.1, 1.3, 1.6, 2.0])
    angle = np.arctan(mu * ratios)
    _, acceleration = slope(ratios, mu, steps=600)
    np.testing.assert_allclose(acceleration, G * (np.sin(angle) - mu * np.cos(angle)), rtol=0.005)


@pytest.mark.parametrize("mu", [0.3, 0.5])
def test_a_bead_creeps_below_the_friction_angle_as_the_law_says(mu):
    # slip d and budget b = mu g cos dt^2 balance when d b / (d^4 + b^4)^(1/4) = g sin dt^2, so with
    # r = tan(angle) / mu the creep is mu g cos dt (r / (1 - r^4)^(1/4) - r)
    ratios = np.array([0.5, 0.7, 0.8, 0.85, 0.88, 0.95])
    speed, _ = slope(ratios, mu, steps=600)
    budget = mu * G * np.cos(np.arctan(mu * ratios)) * DT
    theory = budget * (ratios / (1 - ratios**4) ** 0.25 - ratios)
    np.testing.assert_allclose(speed, theory, rtol=0.01)
    assert (speed[ratios <= 0.88] < 1e-3).all()


def test_a_bead_rests_one_radius_above_the_table():
    builder = new_builder()
    add_particles(builder, [(0, 0, 0.05), (0.1, 0, RADIUS)], velocities=[(0, 0, 0), (0, 0, 1)])
    solver = finalize(builder, IDEAL)
    path = frames(solver, 1200)
    assert path[:, :, 2].min() > RADIUS - 1e-9
    np.testing.assert_allclose(path[-1, :, 2], RADIUS, atol=1e-9)


def test_a_pushed_bead_follows_newton():
    # x = a t^2 / 2 while pushed, on a table without friction
    from warp_deform.objects.push import Push

    builder = new_builder()
    add_particles(builder, [(0, 0, RADIUS)])
    solver = finalize(builder, ideal(table_friction=0.0, rest_seconds=100.0))
    push = Push(0, np.array([3.0, -1.0, 0.0]), 0.2)
    rollout(solver, [0], pushes={0: (push,)}, max_seconds=0.3)
    np.testing.assert_allclose(velocities(solver)[0], [0.6, -0.2, 0], atol=1e-6)
    expected = 3.0 * 0.2 * (0.2 + DT) / 2 + 0.6 * 0.1
    assert positions(solver)[0, 0] == pytest.approx(expected, abs=0.6 * DT)


def heap(config: CableConfig, seed: int, solver_config: SolverConfig, precision: str = "float32"):
    rng = np.random.default_rng(seed)
    n = config.beads
    z = 0.02 + 0.5 * config.spacing * np.arange(n)
    start = np.column_stack([0.5 + rng.normal(0, 3e-3, n), rng.normal(0, 3e-3, n), z])
    builder = new_builder()
    add_cable(builder, config, start)
    return finalize(builder, solver_config, precision=precision)


@pytest.mark.parametrize("seed", range(4))
def test_a_fallen_heap_comes_to_rest_on_the_table_without_overlap(seed):
    config = CableConfig()
    solver = heap(config, seed, SolverConfig())
    watch = rollout(solver, [0], min_seconds=1.0, max_seconds=8.0)[0]
    x = positions(solver)
    assert watch.seconds < 8.0, "never came to rest"
    assert not watch.watch.problems(0, solver.config.limits)
    assert x[:, 2].min() > config.radius - 1e-6
    assert np.abs(velocities(solver)).max() < solver.config.rest_speed
    top = solver.data.topologies[0]
    gap = np.linalg.norm(x[top.pair_ij[:, 0]] - x[top.pair_ij[:, 1]], axis=1)
    assert gap.min() > top.pair_distance.min() - 0.0005
    length = np.linalg.norm(np.diff(x, axis=0), axis=1)
    np.testing.assert_allclose(length, config.spacing, rtol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_falling_heap_never_gains_energy(seed):
    # kinetic + potential + elastic, no air: nothing in the scene can do work
    config = SolverConfig(damping=0.0, limits=LOOSE, max_speed=1e3)
    solver = heap(CableConfig(), seed, config, "float64")
    levels = [energy(solver)]
    for _ in range(60):
        solver.run(30)
        levels.append(energy(solver))
    rise = np.max(np.array(levels[1:]) - np.minimum.accumulate(levels)[:-1])
    assert rise < 1e-3 * levels[0]


def two_beads(distance: float, speed: float, *, masses=(0.1, 0.1), mu=0.0, **changes):
    """Two beads in the air without gravity that approach with `speed` along x."""
    builder = new_builder()
    add_particles(
        builder,
        [(0, 0, 1), (distance, 0, 1)],
        velocities=[(speed, 0, 0), (0, 0, 0)],
        masses=masses,
        colliding=True,
    )
    return finalize(builder, ideal(contact_friction=mu, **changes), gravity=0.0)


@pytest.mark.parametrize("masses", [(0.1, 0.1), (0.1, 0.4), (0.3, 0.1)])
def test_a_central_collision_is_plastic(masses):
    # no restitution: both leave with (m1 v1) / (m1 + m2), up to the recovery speed
    solver = two_beads(0.03, 0.8, masses=masses)
    solver.run(600)
    common = masses[0] * 0.8 / sum(masses)
    speed = velocities(solver)[:, 0]
    assert masses[0] * speed[0] + masses[1] * speed[1] == pytest.approx(masses[0] * 0.8, rel=1e-6)
    assert speed[1] - speed[0] <= solver.config.recovery + 1e-9
    np.testing.assert_allclose(speed, common, atol=solver.config.recovery)
    x = positions(solver)[:, 0]
    assert x[1] - x[0] > 2 * RADIUS - 1e-4


@pytest.mark.parametrize("recovery", [0.05, 0.1, 0.5])
def test_overlap_is_pushed_out_at_the_recovery_speed(recovery):
    # relative speed of two beads that start 4 mm inside each other: recovery, no more
    solver = two_beads(0.006, 0.0, recovery=recovery)
    path = frames(solver, 240)
    gap = path[:, 1, 0] - path[:, 0, 0]
    assert np.diff(gap).max() <= recovery * DT * (1 + 1e-6)
    assert gap[-1] > 2 * RADIUS - 1e-6


def test_a_bead_on_a_bead_column_carries_no_hidden_overlap():
    # three beads exactly on top of each other: depth of order g dt^2
    builder = new_builder()
    column = [(0, 0, RADIUS * (1 + 2 * k)) for k in range(3)]
    add_particles(builder, column, colliding=True)
    solver = finalize(builder, ideal(damping=1.0))
    solver.run(120)
    z = positions(solver)[:, 2]
    assert (np.diff(z) > 2 * RADIUS - 20 * G * DT**2).all(), z


def test_a_bead_slides_over_a_row_of_beads_with_coulomb_friction():
    # a row so dense that it is nearly flat: the speed falls by mu g t more than without friction
    seconds, speeds = 0.05, {}
    for mu in (0.0, 0.3, 0.6):
        builder = new_builder()
        row = [(0.001 * k, 0, RADIUS) for k in range(60)]
        add_particles(builder, row, masses=0.0, colliding=True)
        add_particles(
            builder, [(0.0125, 0, 3 * RADIUS)], velocities=[(0.6, 0, 0)], masses=0.1, colliding=True
        )
        solver = finalize(builder, ideal(contact_friction=mu, table_friction=0.0))
        solver.run(round(seconds / DT))
        speeds[mu] = velocities(solver)[-1, 0]
    for mu in (0.3, 0.6):
        assert speeds[0.0] - speeds[mu] == pytest.approx(mu * G * seconds, rel=0.1), speeds


def test_a_dragged_ring_keeps_its_perimeter():
    config = RingConfig()
    builder = new_builder()
    add_cable(builder, config, cable_ring(config, (0.4, 0.0)))
    solver = finalize(builder, SolverConfig(), precision="float32")
    times = np.array([0.0, 2.0, 2.2])
    start = positions(solver)[0]
    path = np.array([start, start + np.array([0.0, 0.3, 0.0]), start + np.array([0.0, 0.3, 0.0])])
    result = rollout(
        solver, [0], paths={0: GripPath(times, path, particle=0)}, record=0.05, max_seconds=5.0
    )
    x = result[0].frames.particle_q
    edges = np.linalg.norm(x - np.roll(x, -1, axis=1), axis=2)
    perimeter = config.beads * config.spacing
    np.testing.assert_allclose(edges.sum(1), perimeter, rtol=0.02)
    assert result[0].watch.stretch < 1.1
    assert x[..., 2].min() > config.radius - 1e-6


def test_a_dragged_cable_trails_behind_the_tip():
    config = CableConfig()
    builder = new_builder()
    add_cable(builder, config, cable_line(config, (0.3, 0.0), (0.7, 0.0)))
    solver = finalize(builder, SolverConfig(), precision="float32")
    start = positions(solver)[-1]
    path = np.array([start, start + np.array([0.3, 0.0, 0.0])])
    result = rollout(
        solver, [0], paths={0: GripPath(np.array([0.0, 2.0]), path, particle=23)}, max_seconds=5.0
    )
    x = positions(solver)
    np.testing.assert_allclose(x[-1], np.add(start, [0.3, 0, 0]), atol=2e-3)
    assert np.abs(x[:, 1]).max() < 1e-3
    assert result[0].watch.stretch < 1.05


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_friction_between_worlds_is_that_of_each_world(precision):
    one = new_builder()
    add_particles(one, [(0, 0, RADIUS)], velocities=[(0.5, 0, 0)])
    builder = new_builder()
    builder.replicate(one, 3)
    solver = finalize(builder, IDEAL, lanes=8, precision=precision)
    mus = (0.2, 0.4, 0.8)
    for w, mu in enumerate(mus):
        solver.set_world(w, table_friction=mu)
    solver.run(1200)
    for w, mu in enumerate(mus):
        assert positions(solver, w)[0, 0] == pytest.approx(0.25 / (2 * mu * G), abs=0.5 * DT)
