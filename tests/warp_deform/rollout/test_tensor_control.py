"""Derivatives through control steps: against one long rollout, and against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from fixtures.cloth_scenes import two_sheets_and_a_cable
from fixtures.solver_scenes import LOOSE, box_solver, ideal, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import BoxConfig, CableConfig, add_cable, cable_line
from warp_deform.rollout import (
    ControlLoop,
    DifferentiableRollout,
    GripPath,
    TensorControlLoop,
    TensorState,
    rollout,
)
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER
from warp_deform.xpbd.packing.parts import set_parts

CABLE = CableConfig(beads=10)
CUBE = BoxConfig(mass=0.05, friction=0.8)
STEPS = 4
STEP = 60


def cables(worlds: int = 2, **options: object) -> SolverFusedXPBD:
    """Cables crumpled on the table, in as many groups."""
    one, builder = new_builder(), new_builder()
    add_cable(one, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0)))
    builder.replicate(one, worlds)
    solver = SolverFusedXPBD(
        builder.finalize(device="cpu"),
        SolverConfig(damping=20.0, limits=LOOSE),
        lanes=1,
        precision="float64",
        **options,
    )
    for world in range(worlds):
        rng = np.random.default_rng(world)
        z = 0.02 + 0.006 * np.arange(CABLE.beads)
        solver.data.lane("particles.x", world)[:] = np.column_stack(
            [rng.normal(0, 4e-3, (CABLE.beads, 2)), z]
        )
    rollout(solver, list(range(worlds)), min_seconds=0.3, max_seconds=0.3)
    return solver


def sheets(worlds: int = 1) -> SolverFusedXPBD:
    assert worlds == 1
    config = FABRIC_SOLVER
    return two_sheets_and_a_cable(config, edge=0.2, lanes=1, precision="float64")


def ways(solver: SolverFusedXPBD, world: int, particle: int, steps: int = STEPS) -> np.ndarray:
    """Where a tip is at the end of every control step (N, 3)."""
    rng = np.random.default_rng(world)
    moves = rng.uniform((-0.01, -0.01, 0.0), (0.01, 0.01, 0.015), (steps, 3))
    return solver.particle_q(world)[particle] + np.cumsum(moves, axis=0)


def loss(state: TensorState) -> torch.Tensor:
    """Something of all positions and velocities of the state."""
    out = state.positions.new_zeros(())
    for part in state.tensors():
        weights = torch.from_numpy(np.random.default_rng(part.shape[-1]).normal(size=part.shape))
        out = out + (weights * part).sum() + (part * part).sum()
    return out


@pytest.mark.parametrize("make", [cables, sheets])
@pytest.mark.parametrize("storage", ["full", "replay"])
def test_derivatives_are_those_of_one_rollout(
    make: Callable[..., SolverFusedXPBD], storage: str
) -> None:
    held, solver = 1, make()
    worlds = list(range(solver.data.world_count))
    knots = np.stack([ways(solver, w, held) for w in worlds])
    start, speeds = (
        np.stack([read(w) for w in worlds]) for read in (solver.particle_q, solver.particle_qd)
    )
    # one rollout with all knots; in the last world nothing is held
    clock = np.arange(STEPS + 1) * STEP * solver.config.dt
    paths = {
        w: GripPath(
            np.append(clock, 1e6),
            np.vstack([start[w, held], knots[w], knots[w, -1:]]),
            particle=held,
        )
        for w in worlds[: max(1, len(worlds) - 1)]
    }
    whole = DifferentiableRollout(solver)
    positions = whole.forward(worlds, clock[1:], paths=paths, positions=start, velocities=speeds)
    states = [torch.from_numpy(a.copy()).requires_grad_() for a in (positions, whole.velocities)]
    total = sum(
        loss(TensorState(states[0][:, t], states[1][:, t], *[torch.zeros(1, 0, 1)] * 2))
        for t in (1, STEPS - 1)
    )
    total.backward()
    expected = whole.backward(states[0].grad.numpy(), states[1].grad.numpy(), parts=False)

    loop = TensorControlLoop(solver, storage=storage)
    x, v, targets = (torch.from_numpy(a).requires_grad_() for a in (start, speeds, knots))
    loop.begin(worlds, positions=x, velocities=v)
    for w in paths:
        loop.hold(w, particle=held)
    total = 0.0
    for step in range(STEPS):
        state = loop.advance(targets[:, step])
        assert np.array_equal(state.positions.detach().numpy(), positions[:, step])
        if step == 1:
            total = total + loss(state)
    for w in worlds:  # as the end of the rollout does
        loop.let_go(w)
    assert np.array_equal(loop.state.velocities.detach().numpy(), whole.velocities[:, -1])
    total = total + loss(loop.state)
    loop.end()
    for w in worlds:  # what the solver is used for between does not matter
        solver.data.lane("particles.x", w)[:] += 0.3
    rollout(solver, worlds, min_seconds=0.01, max_seconds=0.01)
    left = [solver.particle_q(w) for w in worlds]
    total.backward(retain_graph=True)
    assert all(np.array_equal(solver.particle_q(w), left[w]) for w in worlds)
    by_start = expected.positions.copy()
    for w, path in expected.waypoints.items():
        assert targets.grad[w].numpy() == pytest.approx(path[1:-1], rel=1e-6, abs=1e-9)
        # the path begins where the particle was
        by_start[w, held] += path[0]
    size = np.abs(by_start).max()
    assert x.grad.numpy() == pytest.approx(by_start, rel=1e-6, abs=1e-9 * size)
    assert v.grad.numpy() == pytest.approx(expected.velocities, rel=1e-6, abs=1e-9 * size)
    once = targets.grad.clone()
    total.backward()
    assert torch.equal(targets.grad, 2 * once)


@pytest.fixture(scope="module")
def settled() -> tuple[SolverFusedXPBD, np.ndarray]:
    solver = cables(1)
    return solver, solver.particle_q(0)[None]


def test_derivatives_agree_with_finite_differences_over_control_steps(
    settled: tuple[SolverFusedXPBD, np.ndarray],
) -> None:
    """Held, thrown, caught again; with a waypoint in the middle of every step."""
    solver, start = settled
    knots = np.random.default_rng(0).uniform((0, 0, 0), (1e-3, 1e-3, 2e-3), (4, 1, 2, 3))

    def ends(x: torch.Tensor, v: torch.Tensor, moves: torch.Tensor) -> tuple[torch.Tensor, ...]:
        loop = TensorControlLoop(solver, rate=200.0)  # 6 substeps a step
        loop.begin([0], positions=x, velocities=v)
        loop.hold(0, particle=4)
        for step in range(4):
            if step == 2:
                loop.let_go(0, release="moving")
                loop.advance()
                loop.hold(0, particle=7)
            targets = loop.tips[:, None] + torch.cumsum(moves[step] * 1e-3, dim=1)
            loop.advance(targets)
        state = loop.state
        loop.end()
        return 100 * state.positions, state.velocities

    rng = np.random.default_rng(1)
    inputs = tuple(
        torch.from_numpy(a).requires_grad_()
        for a in (start, rng.normal(0, 0.02, start.shape), 1e3 * knots)
    )
    assert torch.autograd.gradcheck(ends, inputs, eps=1e-6, atol=1e-5, rtol=1e-5, fast_mode=True)


def test_a_box_that_is_held_thrown_and_turned_has_derivatives() -> None:
    solver = box_solver((CUBE, (0, 0, 0.3)), config=ideal(table_friction=0.4))

    def ends(pose: torch.Tensor, knots: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
        unit = pose[..., 3:] / pose[..., 3:].norm(dim=-1, keepdim=True)
        pose = torch.cat([pose[..., :3], unit], dim=-1)
        loop = TensorControlLoop(solver, rate=300.0)
        loop.begin([0], body_poses=pose)
        loop.hold(0, body=0)
        for step in range(3):
            loop.advance(loop.tips + knots[step], loop.turns + turns[step])
        loop.let_go(0, release="moving")
        state = loop.advance()
        loop.end()
        return torch.cat([100 * state.body_poses, state.body_velocities], dim=-1)

    rng = np.random.default_rng(2)
    inputs = tuple(
        torch.from_numpy(a).requires_grad_()
        for a in (
            np.array([[[0.0, 0.1, 0.3, 0.1, -0.2, 0.3, 0.9]]]),
            rng.normal(0, 2e-3, (3, 1, 3)),
            rng.normal(0, 2e-2, (3, 1, 4)),
        )
    )
    assert torch.autograd.gradcheck(ends, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_what_is_freed_is_refused_and_what_is_detached_knows_nothing_of_before(
    settled: tuple[SolverFusedXPBD, np.ndarray],
) -> None:
    solver, start = settled
    loop = TensorControlLoop(solver, rate=200.0)
    first = torch.from_numpy(start).requires_grad_()
    moves = torch.full((2, 1, 3), 1e-3, dtype=torch.float64, requires_grad=True)
    before = loop.begin([0], positions=first)
    loop.hold(0, particle=0)
    before = loop.advance(loop.tips + moves[0])
    after = loop.detach()
    assert loop.nbytes == 0
    assert not after.positions.requires_grad
    after = loop.advance(loop.tips + moves[1])
    loss(after).backward()
    assert first.grad is None
    assert not moves.grad[0].any()
    assert moves.grad[1].any()
    with pytest.raises(InputError, match="freed"):
        loss(before).backward()
    # the steps of an episode may be taken back after its end, but not after the next begins
    loop.end()
    loss(after).backward()
    loop.begin([0])
    with torch.no_grad():
        assert not loop.advance().positions.requires_grad
    with pytest.raises(InputError, match="freed"):
        loss(after).backward()
    with pytest.raises(InputError, match="shape"):
        loop.advance(torch.zeros(2, 3))
    with pytest.raises(InputError, match="finite"):
        loop.advance(torch.full((1, 3), torch.nan))
    with pytest.raises(InputError, match="begun already"):
        loop.begin([0])
    loop.end()
    with pytest.raises(InputError, match="shape"):
        loop.begin([0], positions=torch.zeros(1, 3, 3))
    with pytest.raises(InputError, match="storage"):
        TensorControlLoop(solver, storage="some")
    assert not solver.continued.any()


def test_memory_is_bounded_as_a_whole(settled: tuple[SolverFusedXPBD, np.ndarray]) -> None:
    """Tapes while they fit in a quarter, checkpoints from there on, and then a refusal."""
    solver, start = settled
    gradients, most = {}, {}
    memory = 800_000
    for storage in ("full", "auto"):
        allowed = memory if storage == "auto" else 2**30
        loop = TensorControlLoop(solver, storage=storage, memory=allowed)
        x = torch.from_numpy(start).requires_grad_()
        loop.begin([0], positions=x, velocities=torch.zeros_like(x))
        for _ in range(20):
            state = loop.advance()
        kept = sum(part.tape is not None for part in loop._launch._parts.values())
        loss(state).backward()
        loop.end()
        gradients[storage], most[storage] = x.grad, loop.nbytes
        assert kept == 20 if storage == "full" else 0 < kept < 20
    assert torch.equal(gradients["full"], gradients["auto"])
    assert most["auto"] <= memory < most["full"]
    loop = TensorControlLoop(solver, storage="full", memory=memory)
    loop.begin([0], positions=torch.from_numpy(start).requires_grad_())
    loop.hold(0, particle=3)
    with pytest.raises(InputError, match="allow more memory"):
        for _ in range(20):
            loop.advance(loop.tips + 1e-3)
    where, tip = solver.particle_q(0), loop.tips.clone()
    with pytest.raises(InputError, match="allow more memory"):
        loop.advance(loop.tips + 1e-3)
    assert np.array_equal(solver.particle_q(0), where)
    # it goes on from there once there is room
    loop.detach()
    state = loop.advance(tip + 1e-3)
    assert torch.allclose(state.positions[:, 3], tip + 1e-3, atol=1e-9)
    loop.end()


def test_it_runs_the_bits_of_a_control_loop_and_worlds_begin_again() -> None:
    """In lanes, where one world begins again with other masses in the midst."""
    solver, plain = cables(2), cables(2)
    loop, reference = TensorControlLoop(solver), ControlLoop(plain)
    x = torch.from_numpy(np.stack([solver.particle_q(w) for w in (1, 0)])).requires_grad_()
    loop.begin([1, 0], positions=x)
    reference.begin([0, 1])
    loop.hold(1, particle=2)
    reference.hold(1, particle=2)
    tip = plain.particle_q(1)[2] + [0.01, 0.0, 0.02]
    moves = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    for step in range(3):
        if step == 1:
            for which, one in ((loop, solver), (reference, plain)):
                which.end([0])
                one.set_world(0, table_friction=0.9)
                which.begin([0])
        state = loop.advance(moves + torch.from_numpy(np.stack([tip, [0, 0, 0]])))
        reference.advance(np.stack([[0, 0, 0], tip]))
    got = state.positions.detach().numpy()
    assert np.array_equal(got, reference.particle_q([1, 0]))
    loss(state).backward()
    assert moves.grad[0].any()
    assert not moves.grad[1].any()
    # what began again does not depend on where it was before
    assert x.grad[0].any()
    assert not x.grad[1].any()


def test_what_is_changed_between_steps_counts_from_the_next_on() -> None:
    """As in a `ControlLoop`, to the bit; and each step goes back with what it was run with."""
    held, ends, gradients = 1, [], []
    for kind in (ControlLoop, TensorControlLoop):
        solver = cables(1)
        start, knots = solver.particle_q(0), ways(solver, 0, held)
        targets = torch.from_numpy(knots[:, None]).requires_grad_()
        loop = kind(solver)
        loop.begin([0])
        loop.hold(0, particle=held)
        for step in range(STEPS):
            if step == 2:
                solver.set_world(0, damping=2.0, table_friction=0.05)
                set_parts(
                    solver.data, 0, "rest_lengths", 0.95 * solver.data.topologies[0].spring_length
                )
            state = loop.advance(targets[step] if kind is TensorControlLoop else knots[step, None])
        ends.append(solver.particle_q(0))
        if kind is TensorControlLoop:
            (gradient,) = torch.autograd.grad(loss(state), targets)
            gradients.append(gradient.numpy())
        loop.end()
    assert np.array_equal(*ends) and not np.array_equal(ends[0], start)

    def value(shift: float) -> float:
        solver = cables(1)
        loop = TensorControlLoop(solver)
        loop.begin([0])
        loop.hold(0, particle=held)
        moved = torch.from_numpy(knots[:, None] + shift * way)
        for step in range(STEPS):
            if step == 2:
                solver.set_world(0, damping=2.0, table_friction=0.05)
                set_parts(
                    solver.data, 0, "rest_lengths", 0.95 * solver.data.topologies[0].spring_length
                )
            state = loop.advance(moved[step])
        loop.end()
        return float(loss(state))

    way = gradients[0] / np.linalg.norm(gradients[0])
    measured = (value(1e-7) - value(-1e-7)) / 2e-7
    assert measured == pytest.approx(np.linalg.norm(gradients[0]), rel=1e-4)
