"""What lies between a box and the table passes the box's weight on to the table's friction."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import G, add_particles, finalize, ideal, new_builder, positions

from warp_deform.objects import BoxConfig, add_box
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

DT = 1 / 1200
SPEED = 0.4  # [m/s]
TABLE, GRIPPY, SLIPPERY = 0.5, 0.8, 0.2
RADIUS = 0.005


def slide(solver: SolverFusedXPBD) -> tuple[float, float, float]:
    """All start with `SPEED` along x; ways of the box and of what is under it, and its sinking."""
    solver.run(60)
    box, under = solver.data.views["bodies.x"][0].copy(), positions(solver)[:, 0].mean()
    solver.data.lane("particles.v", 0)[:] = [SPEED, 0, 0]
    solver.data.views["bodies.v"][0] = [SPEED, 0, 0]
    solver.run(round(0.5 / DT))
    moved = solver.data.views["bodies.x"][0] - box
    return moved[0], positions(solver)[:, 0].mean() - under, -moved[2]


def box_on_sheet(mass: float, friction: float) -> SolverFusedXPBD:
    config: SolverConfig = replace(
        FABRIC_SOLVER, table_friction=TABLE, contact_friction=friction, sleep_speed=0.0
    )
    solver, _ = cloth_solver(SMALL, box=(0.5, 0.0, 0.02 + 2 * SMALL.radius), config=config)
    for name in ("bodies.w", "bodies.w0"):
        solver.data.views[name][:] = 1 / mass
    solver.data.views["bodies.inverse_inertia"][:] *= BoxConfig().mass / mass
    solver.data.views["bodies.inertia"][:] *= mass / BoxConfig().mass
    return solver


@pytest.mark.parametrize(("box", "bead"), [(0.1, 0.1), (0.4, 0.1), (0.4, 0.01)])
def test_a_box_that_rides_on_beads_brakes_as_on_the_table(box: float, bead: float) -> None:
    """v^2 / (2 mu g), whatever the masses: the table bears the box, too."""
    builder = new_builder()
    add_box(builder, BoxConfig(mass=box), (0, 0, 0.02 + 2 * RADIUS))
    feet = [(x, y, RADIUS) for x in (-0.015, 0.015) for y in (-0.015, 0.015)]
    add_particles(builder, feet, masses=bead, radius=RADIUS, colliding=True)
    solver = finalize(builder, ideal(table_friction=TABLE, contact_friction=GRIPPY))
    way, _, sunk = slide(solver)
    assert way == pytest.approx(SPEED**2 / (2 * TABLE * G), rel=0.1)
    assert abs(sunk) < 1e-4


@pytest.mark.parametrize("mass", [0.01, 0.1])
def test_a_box_that_rides_on_a_sheet_brakes_as_on_the_table(mass: float) -> None:
    way, _, sunk = slide(box_on_sheet(mass, GRIPPY))
    assert way == pytest.approx(SPEED**2 / (2 * TABLE * G), rel=0.1)
    assert abs(sunk) < 2e-4


def test_a_box_slides_on_a_sheet_that_its_weight_holds_back() -> None:
    """The box brakes by its friction on the sheet; the sheet by the table's under both, less that.

    Each way is v^2 / (2 a), with a = mu g for the box of mass m, and for the sheet of mass M
    a = g (mu_table (M + m) - mu m) / M.
    """
    mass = 0.1
    box, sheet, _ = slide(box_on_sheet(mass, SLIPPERY))
    held = (TABLE * (SMALL.mass + mass) - SLIPPERY * mass) / SMALL.mass
    assert box == pytest.approx(SPEED**2 / (2 * SLIPPERY * G), rel=0.1)
    assert sheet == pytest.approx(SPEED**2 / (2 * held * G), rel=0.1)
