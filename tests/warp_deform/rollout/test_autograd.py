"""Rollouts as functions of tensors: against torch's own check, chained, batched, and after all."""

from __future__ import annotations

import gc
import re
import runpy
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures.places import ROOT
from fixtures.solver_scenes import LOOSE, box_solver, ideal, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import BoxConfig, CableConfig, add_cable, cable_line
from warp_deform.rollout import (
    DifferentiableRollout,
    GripPath,
    TensorRollout,
    rollout,
    rollout_tensors,
)
from warp_deform.solver import SolverConfig, SolverFusedXPBD

DT = 1 / 1200
TINY = CableConfig(beads=4)
CUBE = BoxConfig(mass=0.05, friction=0.8)


def cables(worlds: int = 1, lanes: int = 1, precision: str = "float64") -> SolverFusedXPBD:
    one, builder = new_builder(), new_builder()
    add_cable(one, TINY, cable_line(TINY, (0.4, 0.0), (0.6, 0.0)))
    builder.replicate(one, worlds)
    return SolverFusedXPBD(
        builder.finalize(device="cpu"),
        SolverConfig(damping=5.0, limits=LOOSE),
        lanes=lanes,
        precision=precision,
    )


def tensor(values: object, *, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=dtype, requires_grad=True)


def lines(worlds: int = 1, height: float = 0.05) -> np.ndarray:
    """Cables in the air, not quite straight, world by world (W, P, 3)."""
    line = cable_line(TINY, (0.4, 0.0), (0.6, 0.0))
    noise = np.random.default_rng(0).normal(0, 2e-4, (worlds, *line.shape))
    line[:, 2] = height
    return line + noise * [1, 1, 0 if height < 0.01 else 1]


def led(start: np.ndarray) -> GripPath:
    knots = start + np.array([[0, 0, 0], [1e-3, 5e-4, 2e-3], [2e-3, 0, 1e-3]])
    return GripPath(np.array([0, 0.002, 0.0052]), knots, particle=1)


def test_torch_agrees_on_a_cable_that_is_led_through_the_air() -> None:
    solver = cables()
    x = lines()
    path = led(x[0, 1])
    masses = solver.data.lane("particles.w0", 0).copy()[None]

    def ends(x, v, w, damping, stiffness, knots, times):
        out = rollout_tensors(
            solver,
            [0],
            [3 * DT, 8 * DT],
            positions=x,
            velocities=v,
            inverse_masses=1e3 * w,
            damping=damping,
            stiffness=stiffness,
            paths={0: path},
            waypoints={0: knots},
            knot_times={0: times / 100 * torch.tensor([0.0, 1.0, 1.0])},
        )
        return 100 * out.positions, out.velocities

    rng = np.random.default_rng(1)
    inputs = (
        tensor(x),
        tensor(rng.normal(0, 0.1, x.shape)),
        tensor(masses / 1e3),
        tensor([5.0]),
        tensor([1.0]),
        tensor(path.positions),
        tensor(100 * path.times),
    )
    assert torch.autograd.gradcheck(ends, inputs, eps=1e-7, atol=2e-5, rtol=1e-5, fast_mode=True)


def test_torch_agrees_on_a_cable_that_slides() -> None:
    solver = cables()
    x = lines(height=TINY.radius)

    def ends(x, v, friction):
        out = rollout_tensors(
            solver, [0], [5 * DT], positions=x, velocities=v, table_friction=friction
        )
        return 100 * out.positions, out.velocities

    v = np.random.default_rng(1).normal(0.0, 0.1, x.shape) * [1, 1, 0] + [0.3, 0.3, 0]
    inputs = tensor(x), tensor(v), tensor([0.4])
    assert torch.autograd.gradcheck(ends, inputs, eps=1e-7, atol=2e-5, rtol=1e-4)


def test_torch_agrees_on_a_box_that_flies_and_slides() -> None:
    solver = box_solver((CUBE, (0, 0, 0.02)), config=ideal(table_friction=0.4, damping=1.0))
    twist = np.array([[[0.3, -0.2, 0.5, 6.0, -9.0, 4.0]]])
    pose = np.array([[[0.0, 0.0, 0.3, 0.1, -0.2, 0.3, 0.9]]])

    def ends(pose, twist, damping):
        turn = pose[..., 3:] / pose[..., 3:].norm(dim=-1, keepdim=True)
        out = rollout_tensors(
            solver,
            [0],
            [2 * DT, 5 * DT],
            body_poses=torch.cat([pose[..., :3], turn], -1),
            body_velocities=twist,
            damping=damping,
        )
        return out.body_poses, out.body_velocities

    inputs = tensor(pose), tensor(twist), tensor([1.0])
    assert torch.autograd.gradcheck(ends, inputs, eps=1e-7, atol=1e-5, rtol=1e-4)
    sliding, speed = tensor([[[0.0, 0.0, 0.02, 0, 0, 0, 1]]]), tensor([[[0.6, 0, 0, 0, 0, 0]]])
    end = rollout_tensors(
        solver,
        [0],
        [0.3],
        body_poses=sliding,
        body_velocities=speed,
        damping=torch.zeros(1, dtype=torch.float64),
    )
    end.body_poses[0, -1, 0, 0].backward()
    assert speed.grad is not None and sliding.grad is not None
    assert speed.grad[0, 0, 0] == pytest.approx(0.6 / (0.4 * CUBE.friction * 9.81), rel=0.03)
    assert sliding.grad[0, 0, 0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("storage", ["full", "replay"])
def test_two_actions_are_one_of_both_lengths(storage: str) -> None:
    solver = cables(2)
    start, v = tensor(lines(2, 0.02)), tensor(np.zeros((2, 4, 3)))
    damping = tensor([5.0, 7.0])
    first = rollout_tensors(
        solver,
        [0, 1],
        [0.03, 0.05],
        positions=start,
        velocities=v,
        damping=damping,
        storage=storage,
    )
    second = rollout_tensors(solver, [0, 1], [0.1], damping=damping, storage=storage, **first.end)
    weights = np.random.default_rng(0).normal(size=(2, 2, 1, 4, 3))
    loss = (torch.tensor(weights[0]) * second.positions).sum()
    (loss + (torch.tensor(weights[1]) * second.velocities).sum()).backward()

    run = DifferentiableRollout(solver)
    ends = run.forward(
        [0, 1], [0.15], positions=start.detach().numpy(), velocities=v.detach().numpy()
    )
    expected = run.backward(*weights)
    assert np.allclose(second.positions.detach(), ends, rtol=0, atol=1e-12)
    assert np.allclose(second.velocities.detach(), run.velocities, rtol=0, atol=1e-10)
    for ours, right in (
        (start, expected.positions),
        (v, expected.velocities),
        (damping, expected.damping),
    ):
        assert ours.grad is not None
        assert np.allclose(ours.grad, right, rtol=1e-9, atol=1e-9 * np.abs(right).max())
        assert ours.grad.any()


def test_a_batch_is_its_worlds_one_by_one() -> None:
    def derivatives(
        solver: SolverFusedXPBD, start: np.ndarray, worlds: list[int]
    ) -> tuple[np.ndarray, ...]:
        x = tensor(start, dtype=torch.float32)
        out = rollout_tensors(
            solver, worlds, [0.02, 0.05], positions=x, velocities=torch.zeros_like(x)
        )
        assert out.positions.dtype == out.velocities.dtype == torch.float32
        (out.positions**2).sum().backward()
        assert x.grad is not None and x.grad.dtype == torch.float32
        return out.positions.detach().numpy(), x.grad.numpy()

    start = lines(3, 0.01)
    together = derivatives(cables(3, 8, "float32"), start, [0, 1, 2])
    alone = cables(3, 1, "float32")
    for w in range(3):
        for a, b in zip(together, derivatives(alone, start[w : w + 1], [w]), strict=True):
            assert np.array_equal(a[w], b[0])


def test_derivatives_have_the_precision_of_what_they_are_by() -> None:
    solver = cables(precision="float32")
    x, friction = tensor(lines()), tensor([0.4], dtype=torch.float16)
    out = rollout_tensors(solver, [0], [0.01], positions=x, table_friction=friction)
    assert out.positions.dtype == torch.float32
    assert out.body_poses.shape == (1, 1, 0, 7) and out.body_velocities.shape == (1, 1, 0, 6)
    out.positions.sum().backward()
    assert x.grad is not None and x.grad.dtype == torch.float64
    assert friction.grad is not None and friction.grad.dtype == torch.float16


@pytest.mark.parametrize("storage", ["full", "replay"])
def test_what_happens_to_the_worlds_in_between_does_not_matter(storage: str) -> None:
    solver = cables(2, 8, "float32")

    def act() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, TensorRollout]:
        x, knots, friction = tensor(lines(1, 0.01)), tensor(led(lines()[0, 1]).positions), [0.3]
        mu = tensor(friction)
        out = rollout_tensors(
            solver,
            [1],
            [0.05, 0.4],
            positions=x,
            velocities=torch.zeros_like(x),
            paths={1: led(lines()[0, 1])},
            waypoints={1: knots},
            table_friction=mu,
            storage=storage,
        )
        return x, knots, mu, out

    undisturbed = act()
    (undisturbed[-1].positions ** 2).sum().backward()
    disturbed = act()
    many = np.linspace(0, 0.1, 100)  # a path so long that it needs other arrays
    away = GripPath(many, lines()[0, 2] + many[:, None], particle=2)
    solver.set_world(1, damping=50.0, table_friction=0.9, stiffness=0.5)
    solver.data.lane("particles.w0", 1)[:] *= 2
    solver.data.lane("particles.w", 1)[:] *= 2
    rollout(solver, [0, 1], paths={0: away, 1: away}, min_seconds=0.2, max_seconds=0.2)
    before = {name: view.copy() for name, view in solver.data.views.items()}
    (disturbed[-1].positions ** 2).sum().backward()
    for name in ("particles.x", "particles.v", "group.damping", "grips.position", "particles.w0"):
        assert np.array_equal(solver.data.views[name], before[name])
    for a, b in zip(undisturbed[:-1], disturbed[:-1], strict=True):
        assert a.grad is not None and b.grad is not None and a.grad.any()
        assert torch.equal(a.grad, b.grad)


def test_a_tape_lives_as_long_as_its_graph() -> None:
    solver, x = cables(), tensor(lines())
    first = rollout_tensors(solver, [0], [0.01], positions=x)
    assert first.positions.grad_fn is not None
    tape = weakref.ref(first.positions.grad_fn.run)
    second = rollout_tensors(solver, [0], [0.01], **first.end)
    del first
    gc.collect()
    assert tape() is not None
    del second
    gc.collect()
    assert tape() is None


def test_a_flipped_quaternion_flips_its_derivative() -> None:
    solver = box_solver((CUBE, (0, 0, 0.0202)), config=ideal())
    turns = np.array([[0, 0, 0, 1], [0.01, 0.02, 0.1, 0.99], [0.0, 0.01, 0.2, 0.97]])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    knots = np.array([[0, 0, 0.02], [1e-3, 5e-4, 0.03], [2e-3, 0, 0.04]])
    path = GripPath(np.array([0, 0.002, 0.0052]), knots, body=0, rotations=turns)
    pose = torch.tensor([[[0, 0, 0.02, 0, 0, 0, 1.0]]], dtype=torch.float64)

    def slopes(signs: np.ndarray) -> np.ndarray:
        rotations = tensor(turns * signs)
        out = rollout_tensors(
            solver,
            [0],
            [4 * DT],
            body_poses=pose,
            body_velocities=torch.zeros(1, 1, 6).double(),
            paths={0: path},
            knot_rotations={0: rotations},
        )
        out.body_poses[..., 3:5].sum().backward()
        assert rotations.grad is not None and rotations.grad.any()
        return rotations.grad.numpy()

    signs = np.array([[1.0], [-1.0], [1.0]])
    assert np.array_equal(slopes(signs), signs * slopes(np.ones((3, 1))))


def test_what_has_no_derivative_is_refused_in_one_line() -> None:
    solver, x = cables(), tensor(lines())
    path = led(lines()[0, 1])
    for message, options in (
        (r"positions must have the shape \(1, 4, 3\), not \(4, 3\)", {"positions": x[0]}),
        ("damping must be a tensor of floating-point", {"damping": 5.0}),
        ("damping must be a tensor of floating-point", {"damping": torch.tensor([5])}),
        ("velocities holds numbers that are not finite", {"velocities": x * np.inf}),
        ("waypoints of world 0, which has no path", {"waypoints": {0: x[0]}}),
        (
            r"waypoints of world 0 must have the shape \(3, 3\)",
            {"paths": {0: path}, "waypoints": {0: x[0]}},
        ),
        ("storage must be auto, full or replay", {"storage": "disk"}),
        ("allow more memory", {"storage": "full", "memory": 10_000}),
    ):
        with pytest.raises(InputError, match=message) as error:
            rollout_tensors(solver, [0], [0.1], **options)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"no worlds \[7\]: the solver has 1"):
        rollout_tensors(solver, [7], [0.1])
    out = rollout_tensors(solver, [0], [0.01], positions=x)
    (slope,) = torch.autograd.grad((out.positions**2).sum(), x, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_the_example_of_the_docs_runs(tmp_path: Path) -> None:
    page = ROOT / "docs" / "gradients.md"
    blocks = re.findall(r"```(?:python|py)\n(.*?)```", page.read_text(), re.DOTALL)
    program = tmp_path / "example.py"
    program.write_text("".join(blocks))
    names = runpy.run_path(str(program))
    assert names["knots"].grad.any() and names["friction"].grad.any()
    assert names["losses"][-1] < names["losses"][0]
    assert names["factors"].grad[1] != 0 and names["lengths"].grad.any()
