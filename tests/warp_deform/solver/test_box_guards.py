"""Boxes that lie in each other or under the table are named, and nothing else is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from fixtures.box_scenes import parting_depth
from fixtures.solver_scenes import new_builder
from scipy.spatial.transform import Rotation

from warp_deform.objects import BoxConfig, BoxPart, add_box, l_block
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import PhysicsError, ProblemKind, SolverConfig, SolverFusedXPBD

SIDE = 0.04
FRAME = 1 / 60
WIDTHS = [("float64", 1), ("float32", 8)]
"""Precisions and lanes."""

Scene = Sequence[tuple[BoxConfig, tuple[float, float, float]]]


def box(*size: float) -> BoxConfig:
    return BoxConfig(parts=(BoxPart(size or (SIDE, SIDE, SIDE)),), mass=0.1, friction=0.6)


def solver_of(
    *worlds: Scene, precision: str = "float32", lanes: int = 8, yaw: float = 0.0
) -> SolverFusedXPBD:
    """Boxes and where they stand, world by world."""
    builder = new_builder()
    for scene in worlds:
        one = new_builder()
        for config, position in scene:
            add_box(one, config, position, yaw=yaw)
        builder.add_world(one)
    config = SolverConfig(table_friction=1.0, contact_friction=1.0)
    model = builder.finalize(device="cpu")
    return SolverFusedXPBD(model, config, precision=precision, lanes=lanes)


def named(solver: SolverFusedXPBD, steps: int = 0) -> dict[int, set[ProblemKind]]:
    """The guards that fire, by world; 0 substeps: at the start alone."""
    limits = solver.config.limits
    found = {w: v.problems(w, limits) for w, v in enumerate(solver.run(steps))}
    return {w: {p.kind for p in problems} for w, problems in found.items() if problems}


@pytest.mark.parametrize(("precision", "lanes"), WIDTHS)
def test_the_depths_are_those_of_the_corners(precision, lanes):
    # every world has its own sizes, turns and offsets, of which most overlap
    rng = np.random.default_rng(3)
    sizes = rng.uniform(0.02, 0.08, (9, 2, 3))
    spots = rng.uniform(-0.04, 0.04, (9, 2, 3)) + np.array((0.5, 0.0, 0.02))
    solver = solver_of(
        *([(box(*sizes[w, k]), tuple(spots[w, k])) for k in range(2)] for w in range(9)),
        precision=precision,
        lanes=lanes,
    )
    turns = Rotation.random(18, random_state=4)
    deep, low = [], []
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for w in range(9):
        rows = solver.data.body_rows(w)
        solver.data.views["bodies.q"][rows] = turns[2 * w : 2 * w + 2].as_quat()
        corners = [spots[w, k] + turns[2 * w + k].apply(signs * sizes[w, k] / 2) for k in range(2)]
        deep.append(parting_depth(*corners) / sizes[w].min())
        low.append(max(0.0, -np.concatenate(corners)[:, 2].min()))
    values = solver.run(0)
    np.testing.assert_allclose([v.box_overlap for v in values], deep, atol=2e-5)
    np.testing.assert_allclose([v.box_depth for v in values], low, atol=1e-6)
    assert 4 <= np.count_nonzero(deep) < 9 and 4 <= np.count_nonzero(low) < 9


MIDDLE = (0.5, 0.0, 0.05)
BRICK, PLATE = box(0.06, 0.044, 0.027), box(0.08, 0.08, 0.002)
INSIDE = {
    "coincident": [(box(), MIDDLE), (box(), MIDDLE)],
    "same centre, other size": [(BRICK, MIDDLE), (box(), MIDDLE)],
    "inside a bigger one": [(box(0.1, 0.1, 0.1), MIDDLE), (box(0.02, 0.02, 0.02), (0.48, 0, 0.05))],
    "sunk face on face": [(BRICK, MIDDLE), (BRICK, (0.5, 0.0, 0.06))],
    "thin and coincident": [(PLATE, MIDDLE), (PLATE, MIDDLE)],
}


@pytest.mark.parametrize("scene", INSIDE.values(), ids=INSIDE)
@pytest.mark.parametrize(("precision", "lanes"), WIDTHS)
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_boxes_inside_each_other_are_named(scene, precision, lanes, yaw):
    solver = solver_of(scene, precision=precision, lanes=lanes, yaw=yaw)
    state = solver.model.state()
    with pytest.raises(PhysicsError, match="boxes inside each other in world 0") as caught:
        solver.step(state, solver.model.state(), None, None, FRAME)
    assert ProblemKind.BOX_OVERLAP in {p.kind for p in caught.value.problems}


@pytest.mark.parametrize(("precision", "lanes"), WIDTHS)
@pytest.mark.parametrize("config", [box(), l_block()], ids=["cube", "L"])
def test_a_box_under_the_table_is_named_and_one_on_it_is_not(config, precision, lanes):
    on, under = -config.lowest, -config.lowest - 0.006
    for height, problems in (
        (on, {}),
        (on - 0.004, {}),
        (under, {0: {ProblemKind.BOX_PENETRATION}}),
        (-0.5, {0: {ProblemKind.BOX_PENETRATION}}),
    ):
        solver = solver_of([(config, (0.5, 0.0, height))], precision=precision, lanes=lanes)
        assert named(solver) == problems


def test_the_lowest_corner_counts():
    # a long bar whose centre is well above the table stands on its end, which is 1 cm too low
    solver = solver_of([(box(0.2, 0.02, 0.02), (0.5, 0.0, 0.09))])
    assert named(solver) == {}
    solver.data.views["bodies.q"][0] = Rotation.from_euler("y", 90, degrees=True).as_quat()
    assert named(solver) == {0: {ProblemKind.BOX_PENETRATION}}


@pytest.mark.parametrize("lanes", [1, 8])
def test_two_of_three_boxes_are_named_in_their_world_alone(lanes):
    apart = [(box(), (0.5 + 0.05 * k, 0.0, 0.02)) for k in range(3)]
    for k in range(3):
        together = list(apart)
        together[k] = together[(k + 1) % 3]
        solver = solver_of(apart, apart, together, apart, lanes=lanes)
        assert named(solver, steps=40) == {2: {ProblemKind.BOX_OVERLAP}}


def test_parts_of_one_body_and_scenery_are_not_named():
    # the parts of the L lie in each other; bodies without mass may stand in the table, crossed
    solver = solver_of(
        [
            (l_block(), (0.5, 0.2, 0.02)),
            (box(0.2, 0.02, 0.04), (0.5, 0.0, 0.0)),
            (box(0.02, 0.2, 0.04), (0.5, 0.0, 0.0)),
            (box(), (0.6, -0.2, 0.02)),
        ]
    )
    views = solver.data.views
    for name in ("w", "w0", "inverse_inertia"):
        views[f"bodies.{name}"][1:3] = 0.0
    assert named(solver, steps=40) == {}
    views["bodies.x"][3, :2] = views["bodies.x"][1, :2]
    assert named(solver) == {0: {ProblemKind.BOX_OVERLAP}}


@pytest.mark.parametrize("view", ["bodies.x", "bodies.q"])
@pytest.mark.parametrize("lanes", [1, 8])
def test_a_pose_that_is_no_number_is_named_as_that_alone(view, lanes):
    scene = [(box(), MIDDLE), (box(), MIDDLE)]
    solver = solver_of(scene, scene, lanes=lanes)
    row = solver.data.body_rows(1).start
    for value in (np.nan, np.inf):
        solver.data.views[view][row, 1] = value
        assert named(solver) == {0: {ProblemKind.BOX_OVERLAP}, 1: {ProblemKind.NONFINITE}}


def test_a_world_that_takes_no_part_is_not_looked_at():
    solver = solver_of(
        [(box(), MIDDLE), (box(), MIDDLE)], [(box(), MIDDLE), (box(), (0.6, 0, 0.02))]
    )
    solver.activate(np.array([1]))
    assert named(solver, steps=40) == {}


@pytest.mark.parametrize(
    ("end", "names"),
    [
        ((0.5, 0.0, 0.1), set()),
        ((0.5, 0.0, 0.03), {ProblemKind.BOX_OVERLAP}),
        ((0.4, 0.0, -0.01), {ProblemKind.BOX_PENETRATION}),
    ],
)
@pytest.mark.parametrize(("precision", "lanes"), WIDTHS)
def test_a_held_box_that_is_led_into_something_is_named_later(end, names, precision, lanes):
    # beside it is a box without mass, which does not give way
    scene = [(box(), (0.4, 0.0, 0.1)), (box(0.06, 0.06, 0.06), (0.5, 0.0, 0.03))]
    solver = solver_of(scene, precision=precision, lanes=lanes)
    for name in ("w", "w0", "inverse_inertia"):
        solver.data.views[f"bodies.{name}"][1] = 0.0
    start = solver.data.views["bodies.x"][0].copy()
    path = GripPath(np.array([0.0, 0.4]), np.array([start, end]), body=0)
    result = rollout(solver, [0], paths={0: path}, max_seconds=0.42)[0]
    assert {p.kind for p in result.watch.problems(0, solver.config.limits)} == names


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_box_on_its_twin_stands_and_is_not_named(precision):
    # corners and edges of equal boxes coincide: one rounding step decides on which side they are
    for k in range(12):
        turn = 0.1 + 0.1 * k
        scene = [(BRICK, (0.5, 0.0, 0.0135 + 0.027 * j)) for j in range(2)]
        solver = solver_of(scene, precision=precision, lanes=1, yaw=turn)
        assert named(solver, steps=1200) == {}, turn
        assert abs(solver.data.views["bodies.x"][1, 2] - 0.0405) < 1e-5, turn


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_a_hard_landing_is_not_named(speed):
    # a tilted cube on a plate, as fast as bodies get
    solver = solver_of([(box(0.1, 0.1, 0.02), (0.5, 0.0, 0.01)), (box(), (0.5, 0.0, 0.08))])
    solver.data.views["bodies.q"][1] = Rotation.from_euler("xy", [20, 30], degrees=True).as_quat()
    solver.data.views["bodies.v"][1, 2] = -speed
    values = solver.run(600)[0]
    assert values.problems(0, solver.config.limits) == ()
    assert values.box_overlap < 0.2 and values.box_depth < 0.004
