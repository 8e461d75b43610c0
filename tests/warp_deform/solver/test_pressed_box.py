"""A box between a taut fabric and what lies on the table does not rock; overlaps are no springs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.cloth_scenes import SMALL
from fixtures.solver_scenes import add_particles, body_frames, finalize, ideal, new_builder
from scipy.spatial.transform import Rotation

from warp_deform.objects import BoxConfig, add_box, add_cloth, cloth_sheet
from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC, FABRIC_SOLVER

DT = 1 / 1200
RADIUS = 0.005
OVER = replace(FABRIC, rows=8, columns=8, side=0.14)


def pressed(yaw: float, reach: float) -> SolverFusedXPBD:
    """A cube on a flat sheet, under another one whose corners are held near the table, `reach` [m]
    from the middle. Nothing sleeps.
    """
    builder = new_builder()
    add_cloth(builder, SMALL, cloth_sheet(SMALL, (0.0, 0.0)))
    add_box(builder, BoxConfig(), (0.003, -0.002, 0.02 + 2 * SMALL.radius), yaw=yaw)
    sheet = cloth_sheet(OVER, (0.0, 0.0), height=0.056)
    corners = [0, OVER.columns - 1, len(sheet) - OVER.columns, len(sheet) - 1]
    first = builder.particle_count
    for i in corners:
        way = sheet[i, :2] / np.linalg.norm(sheet[i, :2])
        sheet[i] = *(way * reach), 0.02
    add_cloth(builder, OVER, sheet)
    for i in corners:
        builder.particle_mass[first + i] = 0.0
    config = replace(FABRIC_SOLVER, sleep_speed=0.0, sleep_ramp=1.0)
    return finalize(builder, config, precision="float32", gravity=-9.81)


@pytest.mark.parametrize(("yaw", "reach"), [(0.0, 0.075), (0.3, 0.075), (0.0, 0.08)])
def test_a_box_under_a_taut_fabric_does_not_rock(yaw: float, reach: float) -> None:
    """It did with 0.9 to 1.8 rad/s, to and fro in every other substep, for ever."""
    solver = pressed(yaw, reach)
    solver.run(round(1.5 / DT))
    _, q = body_frames(solver, 300)
    turn = Rotation.from_quat(q[:, 0])
    spin = (turn[1:] * turn[:-1].inv()).as_rotvec() / DT
    assert np.sqrt((spin**2).sum(axis=1).mean()) < 0.2


@pytest.mark.parametrize(("overlap", "undone"), [(5e-5, 1e-5), (2e-4, 4e-5), (1e-3, 0.1 * DT)])
def test_an_overlap_with_a_particle_is_undone_by_a_fifth(overlap: float, undone: float) -> None:
    """At most by `recovery`; what is undone is the speed of the box afterwards."""
    builder = new_builder()
    add_box(builder, BoxConfig(), (0.0, 0.0, 0.5))
    add_particles(builder, [(0.02 + RADIUS - overlap, 0, 0.5)], masses=0.0, radius=RADIUS)
    solver = finalize(builder, ideal(contact_friction=0.0), gravity=0.0)
    solver.run(1)
    assert solver.data.views["bodies.x"][0, 0] == pytest.approx(-undone, rel=1e-4)
    assert solver.data.views["bodies.v"][0, 0] == pytest.approx(-undone / DT, rel=1e-4)


@pytest.mark.parametrize("gap", [0.0, 1e-4])
def test_an_approach_to_a_particle_is_stopped_at_once(gap: float) -> None:
    builder = new_builder()
    add_box(builder, BoxConfig(), (0.0, 0.0, 0.5))
    add_particles(builder, [(0.02 + RADIUS + gap, 0, 0.5)], masses=0.0, radius=RADIUS)
    solver = finalize(builder, ideal(contact_friction=0.0), gravity=0.0)
    solver.data.views["bodies.v"][0] = [0.5, 0, 0]
    solver.run(2)
    assert solver.data.views["bodies.x"][0, 0] == pytest.approx(gap, abs=1e-9)
    assert solver.data.views["bodies.v"][0, 0] == pytest.approx(0.0, abs=1e-9)
