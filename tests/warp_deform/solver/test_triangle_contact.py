"""Contact between particles and triangles: lists, friction, momentum, lanes, guards, bundles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.cloth_scenes import (
    FABRIC,
    SMALL,
    cloth_solver,
    crumpled,
    fold_path,
    two_sheets_and_a_cable,
)
from fixtures.solver_scenes import (
    G,
    add_particles,
    finalize,
    ideal,
    new_builder,
    positions,
    set_gravity,
    tilt,
    velocities,
)

from warp_deform.objects import (
    BoxConfig,
    CableConfig,
    ClothConfig,
    add_box,
    add_cable,
    add_cloth,
    cable_line,
    cloth_sheet,
)
from warp_deform.objects.attributes import attribute
from warp_deform.rollout import rollout
from warp_deform.solver import PhysicsError, ProblemKind, SolverFusedXPBD, replay_bundle
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER


def test_layers_and_beads_lie_on_top_of_each_other():
    solver = two_sheets_and_a_cable()
    result = rollout(solver, [0], max_seconds=4.0)[0]
    assert result.watch.problems(0, solver.config.limits) == ()
    x = positions(solver)
    assert np.median(x[:36, 2]) == pytest.approx(0.004, abs=1e-3)
    # most of the upper sheet lies a layer above; its corners hang over the lower one's edge
    assert np.median(x[36:72, 2]) == pytest.approx(0.010, abs=1e-3)
    inside = np.abs(x[72:, 0] - 0.5) < 0.035
    # bead radius 5 mm and half a layer of 3 mm above the upper sheet
    np.testing.assert_allclose(x[72:][inside, 2], 0.018, atol=2e-3)


def slab_with_a_bead(friction: float, mu: float) -> SolverFusedXPBD:
    """A pinned sheet at 0.1 m and a bead that touches it from above."""
    builder = new_builder()
    config = ClothConfig(friction=friction, rows=20, columns=20)
    add_cloth(builder, config, cloth_sheet(config, (0.5, 0.0), height=0.1))
    top = 0.1 + config.layer_distance(config.spacing) / 2 + 0.005
    add_particles(builder, [(0.45, 0.013, top)], colliding=True)
    solver = finalize(builder, ideal(contact_friction=mu), precision="float64")
    for name in ("w", "w0"):
        solver.data.lane(f"particles.{name}", 0)[:-1] = 0.0
    return solver


@pytest.mark.parametrize(("friction", "mu"), [(1.0, 0.3), (0.5, 0.6)])
def test_a_bead_slides_on_a_sheet_as_coulomb_says(friction, mu):
    solver = slab_with_a_bead(friction, mu)
    angle = np.radians(30)
    set_gravity(solver, 0, tilt(angle))
    seconds = 0.2
    solver.run(round(seconds / solver.config.dt))
    pull = G * (np.sin(angle) - friction * mu * np.cos(angle))
    assert positions(solver)[-1, 0] - 0.45 == pytest.approx(pull * seconds**2 / 2, rel=0.03)
    assert positions(solver)[-1, 2] == pytest.approx(0.108, abs=1e-4)


def test_a_bead_stays_on_a_gentle_slope():
    solver = slab_with_a_bead(1.0, 0.3)
    set_gravity(solver, 0, tilt(np.radians(5)))
    solver.run(round(1.0 / solver.config.dt))
    assert positions(solver)[-1, 0] - 0.45 < 5e-3


@pytest.mark.parametrize("below", [False, True])
def test_a_sheet_has_two_sides(below):
    solver = slab_with_a_bead(1.0, 0.3)
    if below:
        solver.data.lane("particles.x", 0)[-1, 2] = 0.2 - 0.108
        set_gravity(solver, 0, (0, 0, G))
    solver.run(round(0.3 / solver.config.dt))
    assert abs(positions(solver)[-1, 2] - 0.1) == pytest.approx(0.008, abs=1e-4)


def test_sheets_that_collide_keep_momentum_and_gain_no_energy():
    builder = new_builder()
    for height, yaw in ((0.3, 0.0), (0.32, 0.4)):
        add_cloth(builder, SMALL, cloth_sheet(SMALL, (0.5, 0.0), yaw=yaw, height=height))
    solver = finalize(builder, ideal(contact_friction=0.5), gravity=0.0, precision="float64")
    v = solver.data.lane("particles.v", 0)
    v[36:] = [0.1, 0.05, -0.5]
    mass = 1 / solver.data.lane("particles.w0", 0)[:, None]
    before, energy = (mass * v).sum(0), (mass * v**2).sum()
    solver.run(200)
    after = velocities(solver)
    np.testing.assert_allclose((mass * after).sum(0), before, rtol=1e-6)
    assert after[:36, 2].mean() < -0.05, "the lower sheet was struck"
    assert (mass * after**2).sum() < energy


def test_an_overlap_is_undone_at_the_recovery_speed():
    solver = slab_with_a_bead(1.0, 0.3)
    set_gravity(solver, 0, (0, 0, 0))
    solver.data.lane("particles.x", 0)[-1, 2] = 0.105
    solver.run(round(0.02 / solver.config.dt))
    # triangles beside the one below push at a slant and add a little
    assert velocities(solver)[-1, 2] == pytest.approx(solver.config.recovery, rel=0.25)
    assert positions(solver)[-1, 2] == pytest.approx(0.105 + 0.02 * 0.1, abs=6e-4)


def test_a_box_rests_on_a_sheet_on_the_table():
    builder = new_builder()
    add_cloth(builder, FABRIC, cloth_sheet(FABRIC, (0.5, 0.0)))
    add_box(builder, BoxConfig(), (0.5, 0.0, 0.04))
    solver = finalize(builder, CLOTH_SOLVER, precision="float32")
    result = rollout(solver, [0], max_seconds=3.0)[0]
    assert result.watch.problems(0, solver.config.limits) == ()
    pose, twist = solver.data.body_poses(0)
    # on particles of 4 mm radius that lie on the table
    assert pose[0, 2] == pytest.approx(0.02 + 0.008, abs=1.5e-3)
    assert np.abs(twist).max() < 0.05


@pytest.mark.parametrize("turn", [(0, 0, 0, 1), (0.8804762, 0.2798481, 0.1159169, 0.3647052)])
def test_a_box_does_not_fall_through_a_coarse_sheet(turn):
    # a hammock whose cells are wider than the box: flat, and with a corner first
    config = ClothConfig(rows=4, columns=4, side=0.21, exclusion=1.0)
    builder = new_builder()
    add_cloth(builder, config, cloth_sheet(config, (0.5, 0.0), height=0.15))
    add_box(builder, BoxConfig(mass=0.05), (0.51, 0.01, 0.2))
    solver = finalize(builder, CLOTH_SOLVER, precision="float32")
    for name in ("w", "w0"):
        solver.data.lane(f"particles.{name}", 0)[[0, 3, 12, 15]] = 0.0
    solver.data.set_bodies(0, np.array([[0.51, 0.01, 0.2, *np.divide(turn, np.linalg.norm(turn))]]))
    values = solver.run(round(2.0 / solver.config.dt))
    assert values[0].problems(0, solver.config.limits) == ()
    pose, twist = solver.data.body_poses(0)
    lowest = positions(solver)[:, 2].min()
    assert pose[0, 2] > lowest, "it lies in the hammock"
    assert np.abs(twist[0, :3]).max() < 0.1


# -- edges


def crossed_sheets(edge_contact: float, **options) -> SolverFusedXPBD:
    """Two squares on edge, one along y at 0.1 m, one along x whose lower edge is 5 mm above it."""
    config = ClothConfig(rows=2, columns=2, side=0.1, edge_contact=edge_contact)
    builder = new_builder()
    x, _, _ = cloth_sheet(config, (0.0, 0.0)).T
    z = np.repeat([0.0, 0.1], 2)
    add_cloth(builder, config, np.column_stack([np.full(4, 0.5), x, z + 0.1]))
    add_cloth(builder, config, np.column_stack([x + 0.5, np.zeros(4), z + 0.205]))
    return finalize(builder, ideal(), precision="float64", **options)


@pytest.mark.parametrize(("share", "rests"), [(0.0, False), (0.5, True)])
def test_an_edge_rests_on_an_edge_that_it_crosses(share, rests):
    solver = crossed_sheets(share)
    for name in ("w", "w0"):
        solver.data.lane(f"particles.{name}", 0)[:4] = 0.0
    solver.run(round(0.1 / solver.config.dt))
    low = positions(solver)[4:6, 2].mean()
    assert low == pytest.approx(0.203 if rests else 0.205 - G * 0.1**2 / 2, abs=1e-3)


def test_edges_that_collide_keep_momentum():
    solver = crossed_sheets(0.5, gravity=0.0)
    v = solver.data.lane("particles.v", 0)
    v[4:] = [0.0, 0.0, -0.5]
    mass = 1 / solver.data.lane("particles.w0", 0)[:, None]
    before = (mass * v).sum(0)
    solver.run(60)
    after = velocities(solver)
    np.testing.assert_allclose((mass * after).sum(0), before, rtol=1e-6, atol=1e-12)
    assert after[:4, 2].mean() < -0.1


# -- lanes, guards, bundles


def folds(
    lanes: int,
    worlds: list[int],
    box: tuple[float, float, float] | None = None,
    cloth: ClothConfig = SMALL,
) -> dict[int, bytes]:
    """World `seed` folds its sheet in its own way, alone or beside others."""
    solver, _ = cloth_solver(cloth, worlds=len(worlds), lanes=lanes, precision="float32", box=box)
    paths, least = {}, {}
    for w, seed in enumerate(worlds):
        start = positions(solver, w)[0].astype(float)
        paths[w] = fold_path(start, (0.05 + 0.01 * seed, 0.09 - 0.01 * seed))
        least[w] = 0.05 * seed
    rollout(solver, range(len(worlds)), paths=paths, min_seconds=least, max_seconds=1.6)
    return {
        seed: positions(solver, w).tobytes()
        + velocities(solver, w).tobytes()
        + solver.data.body_poses(w)[0].tobytes()
        for w, seed in enumerate(worlds)
    }


def test_a_fold_has_the_same_bits_alone_and_in_lanes():
    seeds = list(range(5))
    alone = {}
    for seed in seeds:
        alone |= folds(1, [seed])
    assert folds(8, seeds) == alone
    assert folds(1, seeds[::-1]) == alone
    assert len(set(alone.values())) == len(seeds)


def test_a_box_in_a_fold_has_the_same_bits_alone_and_in_lanes():
    above, cloth = (0.5, 0.0, 0.03), replace(SMALL, edge_contact=0.2)  # as a bag and its cube
    alone = {}
    for seed in range(3):
        alone |= folds(1, [seed], above, cloth)
    assert folds(8, [2, 0, 1], above, cloth) == alone


def test_a_fold_with_edges_has_the_same_bits_alone_and_in_lanes():
    cloth = replace(SMALL, edge_contact=0.2)
    alone = {}
    for seed in range(3):
        alone |= folds(1, [seed], cloth=cloth)
    assert folds(8, [2, 0, 1], cloth=cloth) == alone


def test_a_list_that_overflows_names_its_world():
    solver, _ = cloth_solver(SMALL, worlds=3, lanes=8, pairs_per_particle=2)
    x = solver.data.lane("particles.x", 1)
    x[:] = crumpled(len(x))
    values = solver.run(10)
    assert [v.overflow > 0 for v in values] == [False, True, False]
    with pytest.raises(PhysicsError, match="overflow in world 1"):
        solver.check(values)


def test_a_coordinate_that_is_not_a_number_is_named():
    solver, _ = cloth_solver(SMALL, worlds=2, lanes=8)
    solver.data.lane("particles.x", 1)[3, 0] = np.nan
    kinds = {
        (p.world, p.kind)
        for w, v in enumerate(solver.run(30))
        for p in v.problems(w, solver.config.limits)
    }
    assert (1, ProblemKind.NONFINITE) in kinds and {w for w, _ in kinds} == {1}


def test_a_bundle_with_triangles_reproduces_the_bits(tmp_path):
    solver, _ = cloth_solver(SMALL, worlds=2, lanes=8, bundles=tmp_path)
    x = solver.data.lane("particles.x", 1)
    x[:] = crumpled(len(x))
    solver.run(30)
    after = replay_bundle(solver.bundle)
    for name, values in solver.data.views.items():
        assert after[name].tobytes() == values.tobytes(), name


def test_worlds_with_and_without_sheets_live_side_by_side():
    plain, sheet = new_builder(), new_builder()
    cable = CableConfig(beads=8)
    for world in (plain, sheet):
        add_cable(world, cable, np.add(cable_line(cable, (0.46, 0.0), (0.6, 0.02)), [0, 0, 0.05]))
    add_cloth(sheet, SMALL, cloth_sheet(SMALL, (0.5, 0.0)))
    builder = new_builder()
    for world in (plain, sheet, plain):
        builder.add_world(world)
    solver = finalize(builder, CLOTH_SOLVER, lanes=8, precision="float32")
    solver.run(600)
    alone = new_builder()
    alone.add_world(plain)
    other = finalize(alone, CLOTH_SOLVER, lanes=1, precision="float32")
    other.run(600)
    for world in (0, 2):
        np.testing.assert_array_equal(positions(solver, world), positions(other))
    assert positions(solver, 1)[3, 2] > positions(solver, 0)[3, 2] + 2e-3


def test_floors_act_without_triangles():
    builder = new_builder()
    add_particles(builder, [(0.5, 0, 0.1), (0.51, 0, 0.1)], links=[(0, 1, 0.02)], stiffness=1e-3)
    builder.custom_attributes[attribute("spring_floor")].values[0] = 0.9
    solver = finalize(builder, ideal(), gravity=0.0)
    solver.run(1)
    x = positions(solver)
    assert np.linalg.norm(x[1] - x[0]) == pytest.approx(0.018, rel=1e-4)
