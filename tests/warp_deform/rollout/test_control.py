"""Control steps: the bits of one launch, whatever happens beside and in between, and refusals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fixtures.bag_scenes import bag_solver
from fixtures.cloth_scenes import cloth_solver
from fixtures.solver_scenes import LOOSE, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import CableConfig, ClothConfig, add_box, add_cable, cable_line, l_block
from warp_deform.rollout import ControlLoop, GripPath, rollout
from warp_deform.solver import GuardLimits, PhysicsError, SolverConfig, SolverFusedXPBD
from warp_deform.support.quaternion import quat_from_yaw, quat_inverse, quat_multiply, quat_rotate
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

CABLE = CableConfig(beads=12)
LINKED = ClothConfig(rows=6, columns=6, side=0.1, edge_contact=0.2)
STEPS = 5
STEP = 60
WORLDS = 3


def cables(worlds: int = WORLDS, lanes: int = 8, **options: object) -> SolverFusedXPBD:
    one, builder = new_builder(), new_builder()
    add_cable(one, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0)))
    add_box(one, l_block(), (0.45, 0.05, 0.02), yaw=0.5)
    builder.replicate(one, worlds)
    model = builder.finalize(device="cpu")
    config = SolverConfig(limits=LOOSE)
    return SolverFusedXPBD(model, config, lanes=lanes, precision="float32", **options)


def fabrics(worlds: int = WORLDS, lanes: int = 8) -> SolverFusedXPBD:
    return cloth_solver(
        LINKED, worlds=worlds, lanes=lanes, config=FABRIC_SOLVER, box=(0.5, 0.0, 0.02), height=0.05
    )[0]


def bags(worlds: int = WORLDS, lanes: int = 8) -> SolverFusedXPBD:
    return bag_solver(worlds, lanes=lanes)[0]


def heap(seed: int) -> np.ndarray:
    """Bead positions of a crumpled start: many contacts."""
    rng = np.random.default_rng(seed)
    z = 0.02 + 0.006 * np.arange(CABLE.beads)
    return np.column_stack([rng.normal(0, 4e-3, (CABLE.beads, 2)), z])


def start(solver: SolverFusedXPBD, world: int, seed: int) -> None:
    """Give a world the start that belongs to a seed."""
    x = solver.data.lane("particles.x", world)
    rng = np.random.default_rng(seed)
    if len(x) == CABLE.beads:
        x[:] = heap(seed)
    else:
        x += rng.normal(0, 3e-4, x.shape).astype(x.dtype)
    solver.data.lane("particles.v", world)[:] = rng.normal(0, 0.05, x.shape)


def targets(place: np.ndarray, seed: int, steps: int = STEPS) -> np.ndarray:
    """Where a tip is at the end of every control step (N, 3): up, and about, at up to 1 m/s."""
    rng = np.random.default_rng(100 + seed)
    ways = rng.uniform((-0.03, -0.03, -0.015), (0.03, 0.03, 0.045), (steps, 3))
    return place + np.cumsum(ways, axis=0)


def bits(solver: SolverFusedXPBD, world: int) -> bytes:
    data, rows = solver.data, solver.data.body_rows(world)
    parts = [data.lane(f"particles.{n}", world) for n in ("x", "v", "w", "still", "anchor")]
    parts += [data.views[f"bodies.{n}"][rows] for n in ("x", "q", "v", "omega", "w")]
    return b"".join(part.tobytes() for part in parts)


def whole_path(solver: SolverFusedXPBD, knots: np.ndarray, **held: object) -> GripPath:
    """All targets after the first knot as one path, which goes on beyond the last."""
    number = solver.data.number
    clock = np.arange(len(knots)).astype(number) * STEP * number(solver.config.dt)
    times = np.append(clock, 1e6)
    return GripPath(times, np.vstack([knots, knots[-1:]]), **held)


@pytest.mark.parametrize("make", [cables, fabrics, bags])
def test_control_steps_have_the_bits_of_one_launch(make: Callable[..., SolverFusedXPBD]) -> None:
    """World 0 holds a particle, 1 holds nothing, 2 is as 1, but begins later and pauses; another
    launch of a fourth world of the same lanes comes in between.
    """
    seconds = STEPS * STEP / 1200
    expected = []
    for seed in (0, 1):
        solver = make(1)
        start(solver, 0, seed)
        place = solver.particle_q(0)[0].astype(float)
        path = whole_path(solver, np.vstack([place, targets(place, seed)]), particle=0)
        paths = {0: path} if seed == 0 else {}
        rollout(solver, [0], paths=paths, min_seconds=2 * seconds, max_seconds=seconds)
        expected.append(bits(solver, 0))
    led = make(4)
    for world, seed in enumerate((0, 1, 1, 2)):
        start(led, world, seed)
    loop = ControlLoop(led)
    assert loop.substeps == STEP
    loop.begin([0, 1])
    loop.hold(0, particle=0)
    ways = targets(led.particle_q(0)[0].astype(float), 0)
    for step in range(STEPS):
        if step == 1:
            rollout(led, [3], min_seconds=0.1, max_seconds=0.1)
            loop.begin([2])
        taking_part = [0, 1, 2][: 2 if step in (0, 3) else 3]
        rows = np.zeros((len(taking_part), 3))
        rows[0] = ways[step]
        assert loop.advance(rows, worlds=taking_part) == {}
    while loop.watch(2).steps < STEPS * STEP:
        loop.advance(worlds=[2])
    assert np.array_equal(loop.particle_q([0])[0], led.particle_q(0))
    loop.end()
    assert [bits(led, world) for world in range(3)] == [*expected, expected[1]]


def test_a_block_that_is_held_aside_turns_as_along_one_path() -> None:
    whole, solver = cables(1), cables(1)
    for one in (whole, solver):
        start(one, 0, 0)
    tip = np.add(solver.body_q(0)[0, :3], (0.01, 0.0, 0.03))
    knots, yaws = np.vstack([tip, targets(tip, 0)]), np.linspace(0.3, 4.3, STEPS + 1)
    turns = quat_from_yaw(yaws)
    loop = ControlLoop(solver)
    loop.begin([0])
    com = solver.data.views["bodies.x"][0].astype(float)
    pose = solver.data.views["bodies.q"][0].astype(float)
    loop.hold(0, body=0, tip=tip, rotation=turns[0])
    for step in range(STEPS):
        loop.advance(knots[None, step + 1], turns[None, step + 1])
    back = quat_inverse(turns[0])
    offset = quat_rotate(back, com - tip)
    path = whole_path(
        whole, knots, body=0, rotations=np.vstack([turns, turns[-1:]]), offset=offset,
        turn=quat_multiply(back, pose),
    )  # fmt: skip
    rollout(whole, [0], paths={0: path}, min_seconds=1.0, max_seconds=STEPS * STEP / 1200)
    held_at = solver.data.views["bodies.x"][0].copy()
    assert held_at == pytest.approx(knots[-1] + quat_rotate(turns[-1], offset), abs=1e-6)
    loop.end()
    assert bits(whole, 0) == bits(solver, 0)
    # a tip that waits stays where it is, although its path keeps only the knots to come
    loop.begin([0])
    loop.hold(0, body=0)
    for _ in range(70):
        loop.advance()
    assert solver.data.views["bodies.x"][0] == pytest.approx(held_at, abs=1e-6)
    assert len(loop.save(0).grip["time"]) == 2


@pytest.mark.parametrize("make", [cables, fabrics, bags])
def test_what_is_held_is_saved_and_goes_on_among_other_worlds(
    make: Callable[..., SolverFusedXPBD],
) -> None:
    solver, other = make(1), make()
    start(solver, 0, 0)
    for world in range(WORLDS):
        start(other, world, 5 + world)
    loop, others = ControlLoop(solver), ControlLoop(other)
    loop.begin([0])
    others.begin([0, 2])
    loop.hold(0, particle=1)
    ways = targets(solver.particle_q(0)[1].astype(float), 0)
    for step in range(STEPS):
        loop.advance(ways[None, step])
        if step == 1:
            others.advance()
            copy_state(solver, other, 1)
            others.restore(1, loop.save(0))
            assert others.holding().tolist() == [False, True, False]
        elif step > 1:
            # what is the target of a world that holds nothing means nothing
            others.advance(np.stack([[7.0] * 3, ways[step], [7.0] * 3]))
    assert bits(other, 1) == bits(solver, 0)
    assert others.watch(1) == loop.watch(0)
    loop.end()
    others.end()
    assert bits(other, 1) == bits(solver, 0)


def copy_state(source: SolverFusedXPBD, to: SolverFusedXPBD, world: int) -> None:
    """Positions, velocities and sleep of the first world of another solver."""
    for name in ("x", "v", "still", "anchor"):
        to.data.lane(f"particles.{name}", world)[:] = source.data.lane(f"particles.{name}", 0)
    for name in ("x", "q", "v", "omega"):
        rows = source.data.body_rows(0)
        to.data.views[f"bodies.{name}"][to.data.body_rows(world)] = source.data.views[
            f"bodies.{name}"
        ][rows]


def test_what_is_let_go_moving_flies_on_and_what_is_let_go_at_rest_falls() -> None:
    solver = cables(2)
    loop = ControlLoop(solver, rate=1200.0)
    for world in range(2):
        solver.data.lane("particles.x", world)[:] = cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))
        solver.data.lane("particles.x", world)[:, 2] = 0.3
    loop.begin([0, 1])
    for world, release in enumerate(("moving", "rest")):
        loop.hold(world, particle=11)
        for _ in range(5):
            ahead = np.add(solver.particle_q(world)[11], (1 / 1200, 0, 0))
            loop.advance(ahead[None], worlds=[world])
        assert solver.particle_qd(world)[11] == pytest.approx([1, 0, 0], abs=1e-3)
        loop.let_go(world, release=release)
        assert not loop.holding([world])[0]
    assert solver.particle_qd(0)[11] == pytest.approx([1, 0, 0], abs=1e-3)
    assert solver.particle_qd(1)[11].tolist() == [0, 0, 0]
    loop.advance()
    assert solver.particle_qd(0)[11, 2] == pytest.approx(-9.81 / 1200, rel=0.5)
    assert (solver.data.lane("particles.w", 0) > 0).all()


def test_the_guards_count_over_all_control_steps_and_name_their_world() -> None:
    solver = cables()
    solver.config = SolverConfig(limits=GuardLimits(stretch=1e9, clamped_steps=80))
    loop = ControlLoop(solver)
    loop.begin([0, 1, 2])
    solver.data.lane("particles.x", 1)[:, 2] = 9.0
    solver.data.lane("particles.v", 1)[:] = [0, 0, -2.9]
    assert loop.advance() == {}
    problems = loop.advance()
    assert list(problems) == [1]
    assert "speed clamp in world 1" in str(PhysicsError(problems[1]))
    assert loop.watch(1).clamped > 80 > loop.watch(0).clamped
    loop.end([1])
    loop.begin([1])
    assert loop.watch(1).clamped == 0


def test_what_control_refuses() -> None:
    solver = cables()
    for rate in (7.0, 0.0, 5000.0, float("nan")):
        with pytest.raises(InputError, match="rate"):
            ControlLoop(solver, rate=rate)
    assert ControlLoop(solver, rate=50.0).substeps == 24
    loop, second = ControlLoop(solver), ControlLoop(solver, rate=10.0)
    loop.begin([0, 1])
    loop.hold(0, particle=3)
    before = [bits(solver, world) for world in range(WORLDS)]

    def refused(match: str, call: Callable[..., object], *given: object, **named: object) -> None:
        with pytest.raises(InputError, match=match) as error:
            call(*given, **named)
        assert "\n" not in str(error.value)

    refused("begun already", loop.begin, [1])
    refused("another control", second.begin, [1])
    refused("no worlds", loop.begin, [3])
    refused("not begun", loop.end, [2])
    refused("not begun", loop.hold, 2, particle=0)
    refused("holds something", loop.hold, 0, particle=0)
    refused("particle or body number 12", loop.hold, 1, particle=12)
    refused("particle or body number -1", loop.hold, 1, body=-1)
    refused("either", loop.hold, 1)
    refused("tip", loop.hold, 1, particle=0, tip=(0, 0, np.nan))
    refused("length 0", loop.hold, 1, particle=0, rotation=(0, 0, 0, 0))
    refused("release", loop.let_go, 0, release="flying")
    refused("calm", loop.let_go, 0, calm=-1.0)
    refused("shape", loop.advance, np.zeros((3, 3)))
    refused("finite", loop.advance, np.full((2, 3), np.nan))
    refused("divide", loop.advance, np.zeros((2, 7, 3)))
    refused("knots a step", loop.advance, np.zeros((2, 4, 3)), np.ones((2, 4)))
    refused("twice", loop.advance, worlds=[0, 0])
    refused("not begun", loop.advance, worlds=[2])
    refused("under control", rollout, solver, [1, 2])
    refused("another scene", second.restore, 2, second_scene())
    assert [bits(solver, world) for world in range(WORLDS)] == before
    assert second.worlds.tolist() == []
    rollout(solver, [2], min_seconds=0.01, max_seconds=0.01)


def second_scene() -> object:
    """What a world of another scene was saved with."""
    loop = ControlLoop(fabrics(1))
    loop.begin([0])
    return loop.save(0)
