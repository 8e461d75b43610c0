"""A world's bits depend on nothing but itself: not on lanes, neighbours, or when those finish."""

from __future__ import annotations

import newton
import numpy as np
import pytest
from fixtures.solver_scenes import add_particles, new_builder

from warp_deform.objects import (
    BoxConfig,
    CableConfig,
    RingConfig,
    add_box,
    add_cable,
    cable_line,
    cable_ring,
    l_block,
)
from warp_deform.objects.push import Push
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD

SHORT = CableConfig(beads=12)
COUNT = 5
"""Worlds of each scene: fills 4 lanes and leaves 8 and 16 half empty."""


def heap(seed: int) -> np.ndarray:
    """Bead positions of a crumpled start: many contacts."""
    rng = np.random.default_rng(seed)
    z = 0.02 + 0.006 * np.arange(SHORT.beads)
    return np.column_stack([rng.normal(0, 4e-3, (SHORT.beads, 2)), z])


def cable_world() -> newton.ModelBuilder:
    builder = new_builder()
    add_cable(builder, SHORT, cable_line(SHORT, (0.4, 0.0), (0.6, 0.0)))
    return builder


def box_world() -> newton.ModelBuilder:
    builder = cable_world()
    add_box(builder, BoxConfig(), (0.45, 0.05, 0.02))
    add_box(builder, l_block(), (0.45, 0.05, 0.08), yaw=0.5)
    return builder


def solver_of(
    world: newton.ModelBuilder, count: int, lanes: int, precision: str
) -> SolverFusedXPBD:
    builder = new_builder()
    builder.replicate(world, count)
    config = SolverConfig()
    return SolverFusedXPBD(builder.finalize(device="cpu"), config, lanes=lanes, precision=precision)


def scatter(solver: SolverFusedXPBD, slots: dict[int, int]) -> None:
    """Give every slot the start of the world that it plays."""
    for slot, seed in slots.items():
        solver.data.lane("particles.x", slot)[:] = heap(seed)
        solver.data.lane("particles.v", slot)[:] = 0.0


def play(solver: SolverFusedXPBD, slots: dict[int, int], seconds: float = 0.6) -> dict[int, bytes]:
    """Grips, pushes and boxes in all worlds; how long a world runs depends on what it plays."""
    paths, pushes, least = {}, {}, {}
    for slot, seed in slots.items():
        if seed % 2:
            start = solver.data.lane("particles.x", slot)[0].astype(float)
            knots = start + np.array([[0, 0, 0], [0.03, 0.01 * seed, 0.02], [0.05, 0, -0.01]])
            paths[slot] = GripPath(np.array([0, 0.1, 0.25]), knots, particle=0, lower=(0.15, 0.25))
        else:
            pushes[slot] = (Push(6, np.array([4.0 * seed, 9.0, 20.0]), 0.05),)
        least[slot] = 0.02 * seed
    most = {slot: seconds * (0.5 + 0.1 * seed) for slot, seed in slots.items()}
    rollout(
        solver,
        list(slots),
        paths=paths,
        pushes=pushes,
        min_seconds=least,
        max_seconds=most,
        calm_after=0.02,
    )
    return {seed: state_bytes(solver, slot) for slot, seed in slots.items()}


def state_bytes(solver: SolverFusedXPBD, world: int) -> bytes:
    data = solver.data
    parts = [data.lane(f"particles.{n}", world).tobytes() for n in ("x", "v")]
    rows = data.body_rows(world)
    parts += [data.views[f"bodies.{n}"][rows].tobytes() for n in ("x", "q", "v", "omega")]
    return b"".join(parts)


ALONE = {seed: seed for seed in range(COUNT)}


@pytest.fixture(scope="module")
def reference() -> dict[tuple[str, str], dict[int, bytes]]:
    """Every world of every scene by itself, one lane."""
    out = {}
    cable, boxes = cable_world(), box_world()
    for scene, precision, world in (
        ("cable", "float32", cable), ("cable", "float64", cable), ("boxes", "float32", boxes)
    ):  # fmt: skip
        states: dict[int, bytes] = {}
        for seed in range(COUNT):
            solver = solver_of(world, 1, 1, precision)
            scatter(solver, {0: seed})
            states |= play(solver, {0: seed})
        out[scene, precision] = states
    return out


@pytest.mark.parametrize(
    ("lanes", "precision"), [(1, "float32"), (4, "float32"), (8, "float32"), (16, "float32"),
                             (8, "float64")],
)  # fmt: skip
def test_cables_have_the_same_bits_in_every_width(reference, lanes, precision):
    solver = solver_of(cable_world(), COUNT, lanes, precision)
    scatter(solver, ALONE)
    assert play(solver, ALONE) == reference["cable", precision]


def test_boxes_have_the_same_bits_in_lanes(reference):
    solver = solver_of(box_world(), COUNT, 8, "float32")
    scatter(solver, ALONE)
    assert play(solver, ALONE) == reference["boxes", "float32"]


def test_the_reference_worlds_differ(reference):
    for states in reference.values():
        assert len(set(states.values())) == COUNT


@pytest.mark.parametrize("order", [(4, 3, 2, 1, 0), (2, 0, 4)])
def test_bits_do_not_depend_on_slot_or_company(reference, order):
    solver = solver_of(box_world(), 7, 8, "float32")
    slots = {6 - k: seed for k, seed in enumerate(order)}
    scatter(solver, slots)
    # the other worlds play something else at the same time
    others = {slot: 7 + slot for slot in range(7) if slot not in slots}
    scatter(solver, others)
    played = play(solver, slots | others)
    for seed in order:
        assert played[seed] == reference["boxes", "float32"][seed], seed


def test_worlds_that_are_left_out_keep_their_bits():
    solver = solver_of(box_world(), 6, 8, "float32")
    scatter(solver, {slot: slot for slot in range(6)})
    solver.data.views["particles.v"][:] += 0.25
    before = {w: state_bytes(solver, w) for w in range(6)}
    rollout(solver, [1, 4], max_seconds=0.1)
    for w in range(6):
        assert (state_bytes(solver, w) == before[w]) == (w not in (1, 4))


def test_a_world_that_is_not_finite_leaves_its_neighbours_alone(reference):
    solver = solver_of(cable_world(), COUNT + 1, 8, "float32")
    scatter(solver, ALONE)
    solver.data.lane("particles.x", COUNT)[:] = np.nan
    assert play(solver, ALONE) == reference["cable", "float32"]
    # and again while it takes part
    solver = solver_of(cable_world(), COUNT + 1, 8, "float32")
    scatter(solver, ALONE)
    solver.data.lane("particles.x", COUNT)[:] = np.nan
    played = play(solver, ALONE | {COUNT: 20})
    for seed in range(COUNT):
        assert played[seed] == reference["cable", "float32"][seed]


def test_finished_worlds_cost_nothing():
    # a launch ends with its last world: steps are counted by world, and the frames of a world that
    # came to rest at once end there
    solver = solver_of(cable_world(), 8, 8, "float32")
    result = rollout(
        solver,
        range(8),
        min_seconds={0: 0.5} | dict.fromkeys(range(1, 8), 0.0),
        max_seconds=5.0,
        record=0.01,
    )
    dt = solver.config.dt
    rest = round(solver.config.rest_seconds / dt)
    steps = [result[w].watch.steps for w in range(8)]
    assert steps == [600] + [rest] * 7
    assert [len(result[w].frames.times) for w in range(8)] == [50] + [5] * 7


def test_contact_lists_leave_out_lanes_that_are_off():
    # in 16 lanes only one world runs; the others lie in a heap and would list every pair
    solver = solver_of(cable_world(), 3, 16, "float32")
    scatter(solver, {0: 0, 1: 1})
    solver.data.lane("particles.x", 2)[:] = cable_line(SHORT, (0, 0), (1, 0))
    solver.activate([2])
    solver.run(50)
    mask = solver.data.views["near.mask"]
    top = solver.data.topologies[0]
    assert mask.sum(0)[[0, 1, *range(3, 16)]].max() == 0
    # straight: beads four links apart are 5.7 cm from each other
    assert mask.sum() < 0.2 * len(top.pair_ij)


def test_mixed_models_equal_each_world_alone():
    ring = RingConfig(beads=16, spacing=2 * 0.04 * np.sin(np.pi / 16), ring_radius=0.04)

    def ring_world() -> newton.ModelBuilder:
        builder = new_builder()
        line = cable_ring(ring, (0.5, 0.0))
        line[:, 2] += 0.01 * np.sin(np.arange(16)) ** 2
        add_cable(builder, ring, line)
        return builder

    def falling_boxes() -> newton.ModelBuilder:
        builder = new_builder()
        add_box(builder, BoxConfig(), (0.5, 0.0, 0.06), yaw=0.3)
        add_box(builder, BoxConfig(), (0.51, 0.01, 0.12))
        return builder

    kinds = [cable_world(), ring_world(), falling_boxes(), box_world()]
    order = [0, 1, 2, 3, 1, 0, 0, 2]
    builder = new_builder()
    for k in order:
        builder.add_world(kinds[k])
    mixed = SolverFusedXPBD(builder.finalize(device="cpu"), lanes=8)
    rollout(mixed, range(len(order)), min_seconds=10.0, max_seconds=0.4)
    for w, k in enumerate(order):
        lone = solver_of(kinds[k], 1, 1, "float32")
        # the kernel without bodies has the same arithmetic for particles
        rollout(lone, [0], min_seconds=10.0, max_seconds=0.4)
        assert state_bytes(mixed, w) == state_bytes(lone, 0), (w, k)


def test_replicate_keeps_what_objects_mean():
    one = cable_world()
    add_particles(one, [(0, 0, 0.5)])
    builder = new_builder()
    builder.replicate(one, 3)
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), lanes=8)
    lone = SolverFusedXPBD(one.finalize(device="cpu"))
    assert len(solver.data.topologies) == 1
    ours, theirs = vars(solver.data.topologies[0]), vars(lone.data.topologies[0])
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)
    assert set(ours["spring_mode"].tolist()) == {0, 1}


def test_a_rollout_is_the_same_twice(reference):
    for _ in range(2):
        solver = solver_of(box_world(), COUNT, 8, "float32")
        scatter(solver, ALONE)
        assert play(solver, ALONE) == reference["boxes", "float32"]
