"""Materials found again from a recording: stiffness of stretch, bend and shear, and lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import LOOSE, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import CableConfig, add_cable, cable_line
from warp_deform.rollout import GripPath, rollout_tensors
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER
from warp_deform.xpbd.packing.parts import parts, set_parts

pytestmark = pytest.mark.in_a_row("adjoints")

RUBBER = CableConfig(beads=10, link_stiffness=3e3, bend_stiffness=20.0, solve="gauss-seidel")
LIMP = replace(SMALL, structural_stiffness=200.0, shear_stiffness=30.0, bend_stiffness=0.5)
TIMES = [0.05, 0.1, 0.15, 0.2]


def rubber(bend: float = 20.0) -> tuple[SolverFusedXPBD, np.ndarray]:
    """A rubber cord without air, and a line in the air from which it swings."""
    cable = replace(RUBBER, bend_stiffness=bend)
    line = cable_line(cable, (0.4, 0.0), (0.6, 0.0)) + np.array([0, 0, 0.4])
    builder = new_builder()
    add_cable(builder, cable, line)
    model = builder.finalize(device="cpu")
    return SolverFusedXPBD(model, SolverConfig(limits=LOOSE), lanes=1, precision="float64"), line


def limp() -> tuple[SolverFusedXPBD, np.ndarray]:
    """A limp sheet above the table, and a bent shape of it that hangs from a corner."""
    solver, _ = cloth_solver(
        LIMP,
        height=0.3,
        config=replace(FABRIC_SOLVER, limits=LOOSE, sleep_speed=0.0),
        lanes=1,
        precision="float64",
    )
    x = solver.particle_q(0)
    x[:, 2] += 0.02 * np.sin(60 * x[:, 0])
    return solver, x


def swing(solver: SolverFusedXPBD, start: np.ndarray, **of: torch.Tensor) -> torch.Tensor:
    """Where the particles are at `TIMES` while the first one is held."""
    held = GripPath(np.array([0.0, 1.0]), np.stack([start[0]] * 2), particle=0)
    x = torch.from_numpy(start[None])
    run = rollout_tensors(
        solver, [0], TIMES, positions=x, velocities=0 * x, paths={0: held}, **of
    )  # fmt: skip
    return run.positions


def fit(
    solver: SolverFusedXPBD,
    start: np.ndarray,
    truth: dict[str, torch.Tensor],
    guess: dict[str, torch.Tensor],
    share: dict[str, torch.Tensor],
) -> list[float]:
    """Factors on materials found by L-BFGS; a material is the springs of one row of `share` (M, S).

    `guess` is what the factors are of; the recording is that of `truth`.
    """
    recording = swing(solver, start, **truth)
    logs = {n: torch.zeros(len(s), dtype=torch.float64, requires_grad=True)
            for n, s in share.items()}  # fmt: skip
    optimizer = torch.optim.LBFGS(
        logs.values(), max_iter=60, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        moved = {n: guess[n] * torch.exp(logs[n] @ share[n]) for n in share}
        value = 1e4 * ((swing(solver, start, **(guess | moved)) - recording) ** 2).sum()
        value.backward()
        return value

    optimizer.step(loss)
    return [float(f) for n in logs for f in torch.exp(logs[n].detach())]


def materials(values: torch.Tensor) -> torch.Tensor:
    """Rows (M, S) of 0 and 1: springs of one stiffness are one material, the softest first."""
    return (values == torch.unique(values)[:, None]).double()


def test_stretch_bend_and_rest_length_of_a_cord() -> None:
    solver, line = rubber()
    stiffness = torch.from_numpy(parts(solver.data, 0, "spring_stiffness"))
    rest = torch.from_numpy(parts(solver.data, 0, "rest_lengths"))
    bend, link, _fold = materials(stiffness)
    assert bend.sum() == 8 and link.sum() == 9
    found = fit(
        solver,
        line,
        truth={"spring_stiffness": stiffness, "rest_lengths": rest},
        guess={
            "spring_stiffness": stiffness * (1 - 0.4 * link + 0.8 * bend),
            "rest_lengths": rest * (1 + 0.1 * link),
        },
        share={"spring_stiffness": torch.stack([bend, link]), "rest_lengths": link[None]},
    )
    assert np.allclose(found, [1 / 1.8, 1 / 0.6, 1 / 1.1], rtol=1e-3)


def test_stretch_shear_and_bend_of_a_sheet() -> None:
    solver, start = limp()
    stiffness = torch.from_numpy(parts(solver.data, 0, "spring_stiffness"))
    share = materials(stiffness)
    assert share.sum(dim=1).tolist() == [48.0, 50.0, 60.0]
    wrong = torch.tensor([0.5, 2.0, 1.5], dtype=torch.float64)
    found = fit(
        solver,
        start,
        truth={"spring_stiffness": stiffness},
        guess={"spring_stiffness": stiffness * (wrong @ share)},
        share={"spring_stiffness": share},
    )
    assert np.allclose(found, 1 / wrong, rtol=1e-3)


def test_the_size_of_beads_that_lie_on_the_table() -> None:
    solver, line = rubber(0.0)
    low = line - [0, 0, 0.4 + 1e-3]
    radii = torch.from_numpy(parts(solver.data, 0, "radii")).requires_grad_()
    x = torch.from_numpy(low[None])
    end = rollout_tensors(solver, [0], [0.5], positions=x, velocities=0 * x, radii=radii)
    end.positions[0, -1, :, 2].sum().backward()
    # whatever pushes it up, a bead ends where its radius says
    assert torch.allclose(radii.grad, torch.ones_like(radii), atol=1e-6)
    assert radii.grad.shape == radii.shape


def test_parts_are_those_of_all_worlds_of_a_topology_and_limits_are_shares() -> None:
    solver, _ = cloth_solver(LIMP, worlds=2, lanes=1, precision="float64")
    rest, data = parts(solver.data, 0, "rest_lengths"), solver.data
    limits = data.views["springs.limit"].copy(), data.views["springs.floor"].copy()
    set_parts(data, 1, "rest_lengths", 1.25 * rest)
    assert np.array_equal(parts(data, 0, "rest_lengths"), 1.25 * rest)
    for name, before in zip(("limit", "floor"), limits, strict=True):
        assert before.any() and np.allclose(data.views[f"springs.{name}"], 1.25 * before)
    set_parts(data, 0, "rest_lengths", rest)
    assert np.allclose(data.views["springs.limit"], limits[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "bad", "says"),
    [
        ("spring_stiffness", lambda k: 0 * k, "positive"),
        ("rest_lengths", lambda k: k[1:], "shape"),
        ("radii", lambda k: k * np.nan, "positive"),
    ],
)
def test_what_no_spring_or_bead_can_be_is_refused(name: str, bad: object, says: str) -> None:
    solver, _ = rubber()
    with pytest.raises(InputError, match=says):
        set_parts(solver.data, 0, name, bad(parts(solver.data, 0, name)))
