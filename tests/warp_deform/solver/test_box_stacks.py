"""Boxes on boxes: pairs face on face, towers, heavy on light, friction between them, impacts."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.box_scenes import (
    Pairs,
    box_of,
    pair_solver,
    place_pairs,
    poses,
    random_pairs,
    tower,
)
from fixtures.solver_scenes import G, box_solver, energy, ideal, tilt
from scipy.spatial.transform import Rotation

from warp_deform.solver import SolverFusedXPBD

DT = 1 / 1200
WIDTHS = [("float32", 8), ("float32", 1), ("float64", 1)]
"""Precisions and lanes."""
SOLID = ideal(table_friction=1.0, contact_friction=1.0)


def stood(pairs: Pairs, precision: str, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the boxes are after a second; no guard has fired."""
    solver = pair_solver(len(pairs.x), precision=precision, lanes=lanes)
    place_pairs(solver, pairs)
    limits = solver.config.limits
    assert all(v.problems(0, limits) == () for v in solver.run(1200))
    return poses(solver)


def assert_stand(pairs: Pairs, x: np.ndarray, turns: np.ndarray) -> None:
    """By the corners, which the solver does not use for it."""
    assert pairs.sunk(x, turns).max() < 5e-5
    assert np.abs(pairs.risen(x)).max() < 5e-5
    up = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix()[:, 2, 2]
    assert np.arccos(np.clip(up, -1, 1)).max() < 1e-3


def test_no_box_sinks_into_the_one_below_alone_or_in_lanes():
    every = random_pairs(320, seed=10_000)
    few = Pairs(every.sizes[:80], every.x[:80], every.turns[:80])
    in_lanes, alone, double = (
        stood(few if lanes == 1 else every, precision, lanes) for precision, lanes in WIDTHS
    )
    for pairs, (x, turns) in ((every, in_lanes), (few, alone), (few, double)):
        assert_stand(pairs, x, turns)
        untilted = np.abs(pairs.turns[:, 1, :2]).max(axis=1) == 0
        assert np.abs(x - pairs.x)[untilted].max() < 2e-5
    for together, single in zip(in_lanes, alone, strict=True):
        assert np.array_equal(together[:80], single)


@pytest.mark.parametrize("lanes", [1, 8])
def test_no_box_sinks_into_its_twin_at_any_yaw(lanes):
    # half of the sizes once more: boxes of both sank at a yaw of 0.4
    size, count = np.array([0.06, 0.044, 0.027]), 64
    sizes = size * np.where(np.arange(count) % 2, 2.0, 1.0)[:, None, None] * np.ones((count, 2, 1))
    x = np.zeros((count, 2, 3))
    x[..., 0] = 0.5
    x[..., 2] = sizes[..., 2] * [0.5, 1.5]
    yaw = np.repeat(0.1 * np.arange(count)[:, None], 2, axis=1)
    turns = Rotation.from_euler("z", yaw.reshape(-1, 1)).as_quat().reshape(count, 2, 4)
    pairs = Pairs(sizes, x, turns)
    ends = stood(pairs, "float32", lanes)
    assert_stand(pairs, *ends)
    assert np.abs(ends[0] - x).max() < 2e-5


def drift(solver: SolverFusedXPBD, seconds: int) -> float:
    """The farthest that a box is from where it was built, looked at every 0.1 s [m]."""
    start, _ = poses(solver)
    farthest = 0.0
    for _ in range(10 * seconds):
        solver.run(120)
        farthest = max(farthest, float(np.abs(poses(solver)[0] - start).max()))
    return farthest


@pytest.mark.parametrize("off", [0.0, 0.002])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_tower_of_ten_stands_for_ten_seconds(off, precision):
    # in line, or each turned and aside
    seed = None if off == 0.0 else 3
    solver = tower([0.04] * 10, [0.05] * 10, seed=seed, off=off, precision=precision, lanes=1)
    assert drift(solver, 10) < 1e-4


@pytest.mark.parametrize("masses", [(0.05, 5.0), (0.05, 5.0, 0.05, 5.0), (5.0, 0.05, 5.0)])
@pytest.mark.parametrize("seed", [None, 0])
def test_heavy_boxes_stand_on_light_ones(masses, seed):
    solver = tower([0.04] * len(masses), masses, seed=seed, off=0.004, precision="float32", lanes=1)
    assert drift(solver, 5) < 1e-4


def test_a_plate_stands_on_four_pillars_under_a_heavy_box():
    pillar, plate = box_of((0.02, 0.02, 0.06)), box_of((0.16, 0.16, 0.01))
    corners = [(x, y) for x in (-0.06, 0.06) for y in (-0.06, 0.06)]
    solver = box_solver(
        *((pillar, (*c, 0.03)) for c in corners),
        (plate, (0.0, 0.0, 0.065)),
        (box_of(0.04, mass=5.0), (0.01, 0.02, 0.09)),
        config=SOLID,
        precision="float32",
    )
    assert drift(solver, 2) < 1e-4


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("masses", [[0.05] * 10, [0.05, 5.0]], ids=["ten", "heavy"])
def test_the_energy_of_what_rests_never_rises(masses, precision):
    solver = tower(
        [0.04] * len(masses), masses, seed=1, off=0.002, config=SOLID, precision=precision, lanes=1
    )
    levels = [energy(solver)]
    for _ in range(300):
        solver.run(4)
        levels.append(energy(solver))
    # starts are rounded to float32: overlaps of some nanometres are given back
    least = 1e-6 if precision == "float32" else 1e-7
    assert np.diff(levels).max() < least * levels[0]
    assert np.ptp(levels) < 1e-4 * levels[0]


def test_what_is_dropped_gains_no_energy():
    # any turns, masses up to a thousand to one: the guess for what rests must not be taken here
    rng = np.random.default_rng(5)
    for seed in range(6):
        sides, masses = rng.uniform(0.02, 0.08, 4), 10 ** rng.uniform(-2, 1, 4)
        solver = tower(
            sides, masses, seed=seed, off=0.01, config=SOLID, precision="float32", lanes=1
        )
        views = solver.data.views
        views["bodies.x"][:, 2] += 0.03 * np.arange(1, 5)
        if seed % 2:
            views["bodies.q"][:] = Rotation.random(4, random_state=seed).as_quat()
        levels = [energy(solver)]
        for _ in range(100):
            solver.run(20)
            levels.append(energy(solver))
        rise = np.max(np.array(levels[1:]) - np.minimum.accumulate(levels)[:-1])
        assert rise < 5e-3 * levels[0]
        assert np.abs(views["bodies.v"]).max() < 0.01


@pytest.mark.parametrize(("ratio", "slides"), [(0.5, False), (0.97, False), (1.2, True), (2, True)])
@pytest.mark.parametrize("mass", [0.05, 5.0])
def test_a_box_slides_on_a_box_as_coulomb_says(ratio, slides, mass):
    # on a held plate: a = g (sin - mu cos) above the friction angle, nothing below it
    mu = 0.6
    angle = np.arctan(ratio * mu)
    solver = box_solver(
        (box_of((1.0, 0.2, 0.02), friction=mu), (0.3, 0, 0.01)),
        (box_of(0.04, mass=mass, friction=mu), (0, 0, 0.04)),
        yaw=[0.0, 0.5],
        config=SOLID,
        gravity=tilt(angle),
    )
    views = solver.data.views
    for name in ("w", "w0", "inverse_inertia"):
        views[f"bodies.{name}"][0] = 0.0
    solver.run(60)
    x, v = views["bodies.x"][1].copy(), views["bodies.v"][1, 0]
    seconds = 0.3
    solver.run(round(seconds / DT))
    if slides:
        expected = G * (np.sin(angle) - mu * np.cos(angle))
        assert (views["bodies.v"][1, 0] - v) / seconds == pytest.approx(expected, rel=2e-3)
    else:
        assert np.abs(views["bodies.x"][1] - x).max() < 1e-5


def test_a_stack_holds_on_a_slope_below_the_friction_angle():
    # the centre of the upper one is above the lower one's foot: tan(angle) is 0.3 of friction 0.6
    for masses in ((0.05, 0.05), (0.05, 5.0)):
        solver = tower(
            [0.04] * 2,
            masses,
            config=SOLID,
            lanes=1,
            precision="float64",
            gravity=tilt(np.arctan(0.3)),
        )
        assert drift(solver, 2) < 1e-5


def test_a_box_that_meets_another_from_the_side_shares_its_momentum():
    solver = box_solver(
        (box_of(0.04, mass=0.3), (0, 0, 0.02)), (box_of(0.04, mass=0.1), (0.05, 0.003, 0.02)),
        config=ideal(table_friction=0.0, contact_friction=0.0),
    )  # fmt: skip
    views = solver.data.views
    views["bodies.v"][0, 0] = 0.6
    solver.run(60)
    v = views["bodies.v"]
    # no bounce: of the points that meet; turning, the centres may part
    assert 0.3 * v[0, 0] + 0.1 * v[1, 0] == pytest.approx(0.3 * 0.6, rel=1e-6)
    assert 0.4 < v[0, 0] < 0.46 and 0.44 < v[1, 0] < 0.6


def test_boxes_that_touch_fall_freely():
    solver = tower([0.04] * 3, [0.05, 5.0, 0.05], config=SOLID, lanes=1, precision="float64")
    views = solver.data.views
    views["bodies.x"][:, 2] += 1.0
    solver.run(120)
    np.testing.assert_allclose(views["bodies.v"][:, 2], -G * 0.1, rtol=1e-9)
    assert np.abs(views["bodies.omega"]).max() < 1e-9


def test_a_heavy_box_that_falls_on_a_light_one_in_the_air_takes_it_along():
    solver = tower([0.04] * 2, [0.05, 5.0], config=SOLID, lanes=1, precision="float64", gravity=0.0)
    views = solver.data.views
    views["bodies.x"][:, 2] += [1.0, 1.001]
    views["bodies.v"][1, 2] = -1.0
    solver.run(12)
    np.testing.assert_allclose(views["bodies.v"][:, 2], -5.0 / 5.05, rtol=1e-4)
