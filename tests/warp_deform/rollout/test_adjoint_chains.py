"""The adjoint of chains and beams that are solved directly, against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from fixtures.adjoint_check import Check, lift, set_state
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import LOOSE, new_builder

from warp_deform.objects import CableConfig, add_cable, cable_line, cable_ring
from warp_deform.rollout import DifferentiableRollout, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

pytestmark = pytest.mark.in_a_row("adjoints")

BEADS = 10


def solver_of(
    *,
    bend: float,
    closed: bool = False,
    worlds: int = 1,
    lanes: int = 1,
    precision: str = "float64",
) -> SolverFusedXPBD:
    cable = CableConfig(beads=BEADS, bend_stiffness=bend, closed=closed, solve="direct")
    line = cable_line(cable, (0.4, 0.0), (0.6, 0.0))
    one, builder = new_builder(), new_builder()
    add_cable(one, cable, cable_ring(cable, (0.5, 0.0)) if closed else line)
    builder.replicate(one, worlds)
    model = builder.finalize(device="cpu")
    return SolverFusedXPBD(
        model, SolverConfig(damping=1.0, limits=LOOSE), lanes=lanes, precision=precision
    )


def shake(solver: SolverFusedXPBD, seed: int, world: int = 0) -> None:
    rng = np.random.default_rng(seed)
    x = solver.particle_q(world)
    x = x + rng.normal(0, 1e-3, x.shape) + [0, 0, 0.02]
    set_state(solver, x, rng.normal(0, 0.5, x.shape), world)


@pytest.mark.parametrize("bend", [0.0, 50.0, 1e4])
@pytest.mark.parametrize("closed", [False, True])
def test_a_substep_and_a_grip(bend: float, closed: bool) -> None:
    solver = solver_of(bend=bend, closed=closed)
    shake(solver, 1)
    acted = Check(solver).assert_right(rounding=30.0)
    assert acted["stretch"] == BEADS - 1 + closed
    assert acted.get("bend", 0) == (bend > 0) * (BEADS if closed else BEADS - 2)
    path = lift(solver.particle_q(0), 3)
    assert Check(solver, 4, path).assert_right(rounding=300.0)["grip"] == 4


def test_a_beam_at_rest_on_the_table() -> None:
    solver = solver_of(bend=5.0)
    rollout(solver, [0], min_seconds=0.3, max_seconds=0.3)
    assert Check(solver).assert_right(rounding=3.0)["table"] == BEADS


def test_bits_depend_neither_on_storage_nor_on_lanes() -> None:
    cotangent = np.random.default_rng(0).normal(size=(1, 1, BEADS, 3))
    found = []
    for worlds, lanes, storage in ((3, 4, "full"), (3, 4, "replay"), (1, 1, "replay")):
        solver = solver_of(bend=50.0, worlds=worlds, lanes=lanes)
        world = worlds - 1
        shake(solver, 7, world)
        run = DifferentiableRollout(solver, storage=storage)
        run.forward([world], [0.1])
        found.append(run.backward(cotangent))
    first = found[0]
    assert np.isfinite(first.positions).all()
    for other in found[1:]:
        for name in ("positions", "velocities", "inverse_masses", "stiffness"):
            assert np.array_equal(getattr(first, name), getattr(other, name)), name


@pytest.mark.parametrize(
    ("stiffness", "columns", "passes"), [(10.0, 6, 1), (2e3, 6, 1), (300, 15, 2)]
)
def test_a_sheet_beyond_its_limits(stiffness: float, columns: int, passes: int) -> None:
    cloth = replace(SMALL, solve="direct", structural_stiffness=stiffness)
    cloth = replace(cloth, rows=6 // passes, columns=columns, side=0.02 * (columns - 1))
    config = replace(FABRIC_SOLVER, damping=4.0, limits=LOOSE, sleep_speed=0.0, max_speed=1e3)
    solver, _ = cloth_solver(cloth, height=0.05, config=config, lanes=1, precision="float64")
    rng = np.random.default_rng(2)
    x = solver.particle_q(0)
    set_state(solver, x + rng.normal(0, 5e-3, x.shape), rng.normal(0, 0.05, x.shape))
    assert solver.data.topologies[0].passes == passes
    acted = Check(solver).assert_right(rounding=30.0, draws=2)
    # rows and columns, and bending springs between second neighbours
    springs = 2 * cloth.rows * columns - cloth.rows - columns
    assert acted["stretch"] == passes * (2 * springs - cloth.rows - columns)
    # soft springs alone would leave some of them too long or too short
    assert acted.get("strain_limit", 0) > 20 or stiffness > 100
