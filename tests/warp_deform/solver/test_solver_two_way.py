"""Boxes with beads and grips: pushes, drapes, carries; momentum goes both ways."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.solver_scenes import (
    LOOSE,
    G,
    add_particles,
    box_solver,
    finalize,
    ideal,
    new_builder,
    positions,
    rotation_matrices,
    tilt,
    velocities,
)

from warp_deform.objects import (
    BoxConfig,
    BoxPart,
    CableConfig,
    add_box,
    add_cable,
    cable_line,
    l_block,
)
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD

DT, RADIUS = 1 / 1200, 0.005
CUBE = BoxConfig(mass=0.05, friction=0.6)
SOLID = SolverConfig(table_friction=1.0, contact_friction=1.0, limits=LOOSE)


def x_of(solver: SolverFusedXPBD) -> np.ndarray:
    """Centres of mass (B, 3), a copy."""
    return solver.data.views["bodies.x"].copy()


def with_beads(
    box: BoxConfig, beads: list, config: SolverConfig, *, z: float | None = None, **options
) -> SolverFusedXPBD:
    """A box at the origin and free beads."""
    builder = new_builder()
    add_box(builder, box, (0, 0, -box.lowest if z is None else z))
    add_particles(builder, beads, colliding=True, **options)
    return finalize(builder, config)


def test_a_bead_rests_on_a_box():
    solver = with_beads(CUBE, [(0.004, -0.01, 0.06)], SOLID, masses=0.01)
    solver.run(1200)
    assert positions(solver)[0, 2] == pytest.approx(0.04 + RADIUS, abs=10 * G * DT**2)
    np.testing.assert_allclose(positions(solver)[0, :2], [0.004, -0.01], atol=3e-4)
    np.testing.assert_allclose(x_of(solver)[0], [0, 0, 0.02], atol=2e-5)
    assert solver.data.views["bodies.touching"][0] == 1


@pytest.mark.parametrize("side", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_bead_that_starts_inside_a_box_leaves_by_the_nearest_face(side):
    at = np.array([*side, 0]) * 0.015
    solver = with_beads(CUBE, [(*at[:2], 0.02)], ideal(recovery=0.2), masses=0.01)
    solver.run(240)
    x = positions(solver)[0] - x_of(solver)[0]
    assert x[:2] @ side > 0.02 + RADIUS - 1e-4
    speed = np.linalg.norm(velocities(solver)[0, :2] - solver.data.views["bodies.v"][0, :2])
    assert speed <= 0.2 * (1 + 1e-6)


def test_a_bead_that_hits_a_box_shares_its_momentum():
    # plastic: m v = (m + M) u for a central hit, without a table or gravity
    builder = new_builder()
    add_box(builder, CUBE, (0, 0, 1.0))
    add_particles(builder, [(-0.04, 0.0, 1.0)], velocities=[(0.6, 0, 0)], masses=0.02)
    solver = finalize(builder, ideal(), gravity=0.0)
    solver.run(240)
    p = 0.02 * velocities(solver)[0] + 0.05 * solver.data.views["bodies.v"][0]
    np.testing.assert_allclose(p, [0.012, 0, 0], atol=1e-8)
    assert solver.data.views["bodies.v"][0, 0] == pytest.approx(0.012 / 0.07, rel=0.02)
    assert np.abs(solver.data.views["bodies.omega"]).max() < 1e-6


def test_an_excentric_hit_conserves_angular_momentum():
    # about the origin: r x m v before; spin and orbit of both after
    builder = new_builder()
    add_box(builder, CUBE, (0, 0, 1.0))
    add_particles(builder, [(-0.04, 0.015, 1.0)], velocities=[(0.6, 0, 0)], masses=0.02)
    solver = finalize(builder, ideal(contact_friction=0.0), gravity=0.0)
    before = np.cross(positions(solver)[0], 0.02 * velocities(solver)[0])
    solver.run(240)
    views = solver.data.views
    turn = rotation_matrices(solver)[0]
    spin = turn @ views["bodies.inertia"][0] @ turn.T @ views["bodies.omega"][0]
    orbit = np.cross(views["bodies.x"][0], 0.05 * views["bodies.v"][0])
    after = spin + orbit + np.cross(positions(solver)[0], 0.02 * velocities(solver)[0])
    assert abs(views["bodies.omega"][0, 2]) > 1.0
    np.testing.assert_allclose(after, before, atol=0.01 * abs(before[2]))


@pytest.mark.parametrize("ratio", [0.8, 1.4])
def test_a_bead_slides_on_a_held_box_by_the_friction_angle(ratio):
    # a = g (sin - mu cos) above the friction angle, creep below it as on the table
    mu = 0.4
    builder = new_builder()
    table = BoxConfig(parts=(BoxPart((2.0, 0.2, 0.1)),), mass=1.0, friction=1.0)
    add_box(builder, table, (0, 0, 0.3))
    add_particles(builder, [(-0.5, 0, 0.35 + RADIUS)])
    angle = np.arctan(ratio * mu)
    solver = finalize(builder, ideal(contact_friction=mu), gravity=tilt(angle))
    solver.data.views["bodies.w"][:] = solver.data.views["bodies.w0"][:] = 0.0
    solver.run(120)
    v = velocities(solver)[0, 0]
    solver.run(600)
    gained = (velocities(solver)[0, 0] - v) / (600 * DT)
    expected = max(0.0, G * (np.sin(angle) - mu * np.cos(angle)))
    assert gained == pytest.approx(expected, abs=0.005 * G)


def push_with_grip(box: BoxConfig, y: float) -> SolverFusedXPBD:
    """A held bead is drawn 12 cm along +x into a box whose near face is 2 cm ahead."""
    builder = new_builder()
    add_box(builder, box, (0, 0, -box.lowest))
    add_particles(builder, [(-0.045, y, 0.015)])
    solver = finalize(builder, SOLID)
    start = positions(solver)[0]
    path = np.array([start, start + np.array([0.12, 0, 0])])
    rollout(
        solver, [0], paths={0: GripPath(np.array([0.0, 1.2]), path, particle=0)}, max_seconds=3.0
    )
    return solver


def test_a_held_bead_pushes_a_box_ahead_of_it():
    # contact at bead x + radius = near face, so the box ends 10 cm further on than it started, and
    # once the bead is let go (at rest) it slides on by v^2 / (2 mu g)
    solver = push_with_grip(CUBE, 0.0)
    slide = 0.1**2 / (2 * 0.6 * G)
    assert x_of(solver)[0, 0] == pytest.approx(-0.045 + 0.12 + RADIUS + 0.02 + slide, abs=2e-4)
    assert x_of(solver)[0, 2] == pytest.approx(0.02, abs=1e-4)
    assert abs(x_of(solver)[0, 1]) < 2e-3
    assert np.abs(solver.data.views["bodies.v"]).max() < 5e-3


def test_a_push_beside_the_centre_turns_the_box():
    left, right = push_with_grip(CUBE, 0.01), push_with_grip(CUBE, -0.01)
    yaw = [np.arctan2(r[0, 1, 0], r[0, 0, 0]) for r in map(rotation_matrices, (left, right))]
    assert yaw[0] < -0.1 and yaw[1] > 0.1
    assert yaw[0] == pytest.approx(-yaw[1], rel=0.1)


def drape(box: BoxConfig, offset: float, config: SolverConfig) -> SolverFusedXPBD:
    """A cable that falls across a box; offset: of its middle from the box's [m]."""
    cable = CableConfig(beads=24, mass=0.01)
    line = cable_line(cable, (-0.5, 0.0), (0.5, 0.0))
    line[:, 0] += offset - line[:, 0].mean()
    line[:, 2] = -2 * box.lowest + 2 * cable.radius
    builder = new_builder()
    add_box(builder, box, (0, 0, -box.lowest))
    add_cable(builder, cable, line)
    return finalize(builder, config)


def test_a_cable_drapes_over_a_box():
    block = BoxConfig(parts=(BoxPart((0.08, 0.08, 0.06)),), mass=0.5, friction=1.0)
    solver = drape(block, 0.0, SolverConfig(limits=LOOSE))
    rollout(solver, [0], min_seconds=1.0, max_seconds=4.0)
    x, box = positions(solver), x_of(solver)[0]
    np.testing.assert_allclose(box, [0, 0, 0.03], atol=1e-3)
    on_top = np.abs(x[:, 0]) < 0.03
    np.testing.assert_allclose(x[on_top, 2], 0.06 + RADIUS, atol=1e-3)
    assert x[0, 2] < 0.02 and x[-1, 2] < 0.02
    inside = (np.abs(x - box) < np.array([0.04, 0.04, 0.03]) + 0.9 * RADIUS).all(1)
    assert not inside.any()
    np.testing.assert_allclose(np.linalg.norm(np.diff(x, axis=0), axis=1), 0.01414, rtol=0.03)


def test_a_cable_that_slides_off_a_box_pushes_it_the_other_way():
    # no friction with the table, so the horizontal momentum of cable and box together stays 0
    block = BoxConfig(parts=(BoxPart((0.08, 0.08, 0.06)),), mass=0.1, friction=1.0)
    solver = drape(block, 0.08, ideal(table_friction=0.0, contact_friction=0.2))
    fastest = 0.0
    for _ in range(20):
        solver.run(30)
        cable = 0.01 * velocities(solver)[:, 0].sum()
        box = 0.1 * solver.data.views["bodies.v"][0, 0]
        assert cable + box == pytest.approx(0.0, abs=1e-6)
        fastest = max(fastest, abs(box))
    assert fastest > 0.1 * 0.01


def carry(config: BoxConfig, height: float, turn: float) -> tuple[SolverFusedXPBD, np.ndarray]:
    """Lift a box, carry it 30 cm, turn it, lower it until it touches, let go."""
    solver = box_solver((config, (0.3, 0, -config.lowest)), config=SOLID)
    start = x_of(solver)[0]
    end = np.add(start, (0.3, 0.1, 0))
    times = np.array([0, 0.3, 0.9, 1.5, 1.7])
    up = np.array([0, 0, height])
    knots = np.array([start, start + up, end + up, end - [0, 0, 0.01], end - [0, 0, 0.01]])
    half = np.array([0, 0, turn, turn, turn]) / 2
    zero = np.zeros(5)
    rotations = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    path = GripPath(times, knots, body=0, rotations=rotations, lower=(0.9, 1.5))
    rollout(solver, [0], paths={0: path}, min_seconds=0.5, max_seconds=4.0)
    return solver, end


@pytest.mark.parametrize("config", [CUBE, l_block()], ids=["cube", "L"])
@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_a_carried_box_stays_where_it_is_let_go(config, turn):
    solver, end = carry(config, 0.08, turn)
    # lowering ends within one substep's travel (0.15 m/s dt) and 0.1 mm of the table
    np.testing.assert_allclose(x_of(solver)[0], end, atol=3e-4)
    yaw = np.arctan2(rotation_matrices(solver)[0, 1, 0], rotation_matrices(solver)[0, 0, 0])
    assert yaw == pytest.approx(turn, abs=0.005)
    assert rotation_matrices(solver)[0, 2, 2] > np.cos(0.005)


def test_a_box_lowered_onto_another_stops_there():
    solver = box_solver((CUBE, (0, 0, 0.02)), (CUBE, (0.2, 0, 0.02)), config=SOLID)
    times = np.array([0, 0.4, 0.8, 1.6, 1.8])
    knots = np.array([[0.2, 0, 0.02], [0.2, 0, 0.1], [0.003, 0, 0.1], [0.003, 0, 0], [0.003, 0, 0]])
    path = GripPath(times, knots, body=1, lower=(0.8, 1.6))
    rollout(solver, [0], paths={0: path}, min_seconds=0.5, max_seconds=4.0)
    np.testing.assert_allclose(x_of(solver), [[0, 0, 0.02], [0.003, 0, 0.06]], atol=5e-4)


def test_a_held_box_pushes_beads_out_of_its_way():
    builder = new_builder()
    add_box(builder, CUBE, (0, 0, 0.022))
    add_particles(builder, [(0.06, 0.002, RADIUS), (0.08, -0.003, RADIUS)], colliding=True)
    solver = finalize(builder, SOLID)
    path = np.array([[0, 0, 0.022], [0.1, 0, 0.022]])
    rollout(solver, [0], paths={0: GripPath(np.array([0.0, 1.0]), path, body=0)}, max_seconds=2.0)
    assert (positions(solver)[:, 0] > 0.1 + 0.02 + 0.9 * RADIUS).all()


def test_a_lowered_bead_stops_at_another():
    # the descent ends when the held bead touches the one under it, and it is let go there
    builder = new_builder()
    add_particles(builder, [(0, 0, RADIUS), (0, 0, 0.05)], masses=[0.0, 0.1], colliding=True)
    solver = finalize(builder, SOLID)
    knots = np.array([[0, 0, 0.05], [0, 0, 0.004], [0, 0, 0.004]])
    path = GripPath(np.array([0, 0.5, 0.6]), knots, particle=1, lower=(0.0, 0.5))
    result = rollout(solver, [0], paths={0: path}, max_seconds=0.6, record=DT)
    z = result[0].frames.particle_q[:, 1, 2]
    assert z[-2] == pytest.approx(3 * RADIUS, abs=2 * 0.092 * DT)
