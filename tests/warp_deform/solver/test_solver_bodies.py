"""Boxes: rest, stacks, slopes, edges, toppling, friction, and what they do to beads and back."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.solver_scenes import (
    LOOSE,
    G,
    body_frames,
    box_solver,
    energy,
    ideal,
    rotation_matrices,
    tilt,
)
from scipy.spatial.transform import Rotation

from warp_deform.objects import (
    BoxConfig,
    BoxPart,
    l_block,
)
from warp_deform.solver import SolverConfig, SolverFusedXPBD

DT = 1 / 1200
CUBE = BoxConfig(mass=0.05, friction=0.6)
PLATE = BoxConfig(parts=(BoxPart((0.08, 0.08, 0.02)),), mass=0.1, friction=0.3)
BAR = BoxConfig(parts=(BoxPart((0.12, 0.02, 0.02)),), mass=0.05, friction=0.6)
SOLID = SolverConfig(table_friction=1.0, contact_friction=1.0, limits=LOOSE)


def block(size: tuple[float, float, float], friction: float, mass: float = 0.1) -> BoxConfig:
    return BoxConfig(parts=(BoxPart(size),), mass=mass, friction=friction)


def x_of(solver: SolverFusedXPBD) -> np.ndarray:
    """Centres of mass (B, 3), a copy."""
    return solver.data.views["bodies.x"].copy()


def tilts(solver: SolverFusedXPBD) -> np.ndarray:
    """Angle of each body's z axis from the vertical [rad]."""
    return np.arccos(np.clip(rotation_matrices(solver)[:, 2, 2], -1, 1))


def assert_stands(solver: SolverFusedXPBD, start: np.ndarray, *, settle: float = 0.5) -> None:
    """Within 1 mm of where it was built, upright, and without creep or jitter for 2 s."""
    solver.run(round(settle / DT))
    settled = x_of(solver)
    np.testing.assert_allclose(settled, start, atol=1e-3)
    assert tilts(solver).max() < np.radians(0.2)
    x, _ = body_frames(solver, 2400, 10)
    assert np.abs(x - settled).max() < 1e-5


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("config", [CUBE, PLATE, BAR, l_block()], ids=["cube", "plate", "bar", "L"])
def test_a_box_rests_flat_without_creep(config, precision):
    solver = box_solver(
        (config, (0.5, 0, -config.lowest)), config=SOLID, yaw=0.4, precision=precision
    )
    assert_stands(solver, x_of(solver))
    lowest = x_of(solver)[0, 2] + config.lowest - config.inertia()[0][2]
    assert abs(lowest) < 1e-4


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("drop", [0.0, 0.004])
@pytest.mark.parametrize("order", [1, -1], ids=["upwards", "downwards"])
def test_a_stack_stands(count, drop, order):
    # each cube 2 mm beside the one below: the centre of mass stays far inside the support
    spots = [(CUBE, (0.002 * (k % 2), 0.001 * k, 0.02 + (0.04 + drop) * k)) for k in range(count)]
    solver = box_solver(*spots[::order], config=SOLID, precision="float32")
    stacked = np.array([(p[0], p[1], 0.02 + 0.04 * k) for k, (_, p) in enumerate(spots)])[::order]
    assert_stands(solver, stacked)


def test_a_small_box_stands_on_a_large_one_whatever_their_order():
    large = block((0.2, 0.2, 0.04), 0.6, 1.0)
    parts = [(large, (0, 0, 0.02)), (CUBE, (0.03, -0.02, 0.06))]
    for order in (1, -1):
        solver = box_solver(*parts[::order], config=SOLID)
        assert_stands(solver, np.array([p for _, p in parts[::order]]))


def test_a_large_box_stands_on_a_small_one():
    large = block((0.2, 0.2, 0.02), 0.6, 0.2)
    for parts in (
        [(CUBE, (0, 0, 0.02)), (large, (0, 0, 0.05))],
        [(large, (0, 0, 0.05)), (CUBE, (0, 0, 0.02))],
    ):
        solver = box_solver(*parts, config=SOLID)
        assert_stands(solver, np.array([p for _, p in parts]))


@pytest.mark.parametrize("yaw", [np.pi / 2, 1.2, 0.6])
def test_bars_lie_across_each_other(yaw):
    # faces that overlap only where their edges cross
    solver = box_solver((BAR, (0, 0, 0.01)), (BAR, (0, 0, 0.03)), yaw=[0.0, yaw], config=SOLID)
    assert_stands(solver, np.array([[0, 0, 0.01], [0, 0, 0.03]]))


def test_boxes_balance_edge_on_edge():
    # two bars standing on an edge, crossed: one contact of two edges carries the upper one, so it
    # falls no further than the edges let it before it topples: the gap stays closed for a while
    solver = box_solver((BAR, (0, 0, 0.02)), (BAR, (0, 0, 0.055)), config=SOLID)
    views = solver.data.views
    views["bodies.q"][0] = Rotation.from_euler("x", 45, degrees=True).as_quat()
    views["bodies.q"][1] = Rotation.from_euler("ZX", [90, 45], degrees=True).as_quat()
    views["bodies.w"][0] = views["bodies.w0"][0] = 0.0
    diagonal = 0.01 * np.sqrt(2)
    views["bodies.x"][0, 2] = diagonal
    views["bodies.x"][1, 2] = 3 * diagonal + 1e-3
    x, _ = body_frames(solver, 48)
    assert x[-1, 1, 2] == pytest.approx(3 * diagonal, abs=2e-4)
    assert x[:, 1, 2].min() > 3 * diagonal - 2e-4


@pytest.mark.parametrize("angles", [(0.75, 0.1, 0.2), (0.7, 0.0, 0.0), (0.3, 0.6, 0.0)])
def test_a_box_dropped_on_an_edge_settles_on_a_face(angles):
    solver = box_solver((CUBE, (0, 0, 0.06)), config=SOLID)
    solver.data.views["bodies.q"][0] = Rotation.from_euler("xyz", angles).as_quat()
    solver.run(2400)
    # some face is level: one row of the rotation is the vertical
    assert np.abs(rotation_matrices(solver)[0, 2]).max() > np.cos(np.radians(0.2))
    assert x_of(solver)[0, 2] == pytest.approx(0.02, abs=1e-4)
    assert np.abs(solver.data.views["bodies.v"]).max() < 1e-3


@pytest.mark.parametrize(
    "config", [CUBE, PLATE, block((0.03, 0.06, 0.04), 0.15)], ids=["cube", "plate", "flat"]
)
def test_a_box_slides_to_a_stop_after_v2_over_2_mu_g(config):
    mu, speed = config.friction, 0.8
    solver = box_solver((config, (0, 0, -config.lowest)), config=ideal(table_friction=1.0))
    solver.data.views["bodies.v"][0] = speed, 0, 0
    solver.run(2400)
    assert x_of(solver)[0, 0] == pytest.approx(speed**2 / (2 * mu * G), abs=2 * speed * DT)
    assert np.abs(solver.data.views["bodies.v"]).max() < 1e-3
    assert np.abs(x_of(solver)[0, 1]) < 1e-3


def on_slope(
    config: BoxConfig, ratio: float, seconds: float, solver_config: SolverConfig | None = None
):
    """Acceleration and distance [m] down a slope with tan(angle) = ratio * friction."""
    angle = np.arctan(ratio * config.friction)
    solver = box_solver(
        (config, (0, 0, -config.lowest)),
        config=solver_config or ideal(table_friction=1.0),
        gravity=tilt(angle),
    )
    solver.run(240)
    x, v = x_of(solver)[0], solver.data.views["bodies.v"][0, 0]
    solver.run(round(seconds / DT))
    return (solver.data.views["bodies.v"][0, 0] - v) / seconds, x_of(solver)[0] - x, angle


@pytest.mark.parametrize("config", [CUBE, PLATE], ids=["cube", "plate"])
@pytest.mark.parametrize("ratio", [1.05, 1.3, 1.6])
def test_a_box_slides_above_the_friction_angle(config, ratio):
    # a = g (sin - mu cos)
    acceleration, _, angle = on_slope(config, ratio, 0.5)
    expected = G * (np.sin(angle) - config.friction * np.cos(angle))
    assert acceleration == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("config", [CUBE, PLATE], ids=["cube", "plate"])
@pytest.mark.parametrize("ratio", [0.3, 0.85, 0.98])
def test_a_box_holds_below_the_friction_angle(config, ratio):
    _, moved, _ = on_slope(config, ratio, 1.0)
    assert np.abs(moved).max() < 1e-5


def test_a_tall_box_tips_on_a_slope_before_it_slides():
    # it tips when tan(angle) > width / height, here 0.4; friction would hold to 0.9
    tall = block((0.02, 0.04, 0.05), 0.9)
    for slope, stands in ((0.36, True), (0.44, False)):
        solver = box_solver(
            (tall, (0, 0, 0.025)), config=ideal(table_friction=1.0), gravity=tilt(np.arctan(slope))
        )
        solver.run(1200)
        assert (tilts(solver)[0] < 0.01) == stands, slope


@pytest.mark.parametrize(("overhang", "stays"), [(0.036, True), (0.044, False)])
def test_a_plate_topples_once_its_centre_is_past_the_edge(overhang, stays):
    # support of 8 cm, so the edge is at 4 cm
    base = block((0.08, 0.08, 0.04), 0.6, 1.0)
    solver = box_solver((base, (0, 0, 0.02)), (PLATE, (overhang, 0, 0.05)), config=SOLID)
    solver.run(1200)
    assert (tilts(solver)[1] < 0.01) == stays


@pytest.mark.parametrize(("shift", "stays"), [(-0.004, True), (0.004, False)])
def test_the_l_block_stands_on_a_leg_only_if_its_centre_of_mass_is_above_it(shift, stays):
    # on the edge of a table-high block: the centre of mass is at (12.5, 12.5) mm, not at the origin
    config = l_block()
    base = block((0.2, 0.2, 0.04), 0.6, 5.0)
    centre = config.inertia()[0][0]
    solver = box_solver(
        (base, (0, 0, 0.02)), (config, (0.1 - centre + shift, 0, 0.06)), config=SOLID
    )
    solver.run(1200)
    assert (tilts(solver)[1] < 0.02) == stays


def test_a_sliding_box_drags_the_one_below_by_friction():
    # upper cube: a = -mu g; lower plate on a frictionless table: a = mu g m_upper / m_lower
    upper, lower = block((0.04, 0.04, 0.04), 0.4, 0.1), block((0.3, 0.1, 0.02), 0.4, 0.2)
    config = ideal(table_friction=0.0, contact_friction=1.0)
    solver = box_solver((lower, (0, 0, 0.01)), (upper, (-0.05, 0, 0.04)), config=config)
    solver.run(60)
    views = solver.data.views
    views["bodies.v"][1] = 0.5, 0, 0
    momentum = np.array([0.2, 0.1]) @ views["bodies.v"][:, 0]
    seconds = 0.05
    solver.run(round(seconds / DT))
    v = views["bodies.v"][:, 0]
    assert v[1] == pytest.approx(0.5 - 0.4 * G * seconds, abs=0.4 * G * 2 * DT)
    assert v[0] == pytest.approx(0.4 * G * seconds / 2, abs=0.4 * G * 2 * DT)
    assert 0.2 * v[0] + 0.1 * v[1] == pytest.approx(momentum, rel=1e-6)


def test_no_stack_gains_energy():
    spots = [(CUBE, (0.004 * k, 0.003 * k, 0.03 + 0.05 * k)) for k in range(3)]
    solver = box_solver(
        *spots, yaw=[0.2, 0.9, 1.7], config=ideal(table_friction=1.0, contact_friction=1.0)
    )
    levels = [energy(solver)]
    for _ in range(80):
        solver.run(15)
        levels.append(energy(solver))
    rise = np.max(np.array(levels[1:]) - np.minimum.accumulate(levels)[:-1])
    assert rise < 1e-3 * levels[0]
