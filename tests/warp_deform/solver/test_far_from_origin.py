"""Free fall is free fall anywhere: velocities are not as coarse as float32 positions are there."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.bag_scenes import BAG, SHELL
from fixtures.solver_scenes import IDEAL, G, add_particles, finalize, new_builder
from scipy.spatial.transform import Rotation

from warp_deform.objects import (
    BoxConfig,
    CableConfig,
    ClothConfig,
    add_bag,
    add_box,
    add_cable,
    add_cloth,
    cable_line,
    cloth_sheet,
)
from warp_deform.solver import SolverFusedXPBD

TURN = Rotation.from_rotvec([0.5, -0.8, 0.3]).as_matrix()  # so that no spring lies along an axis
PLACES = ((0.0, 0.0, 2.4), (0.0, 0.0, 24.0), (24.0, -24.0, 2.4))
TIME = 0.2


def scene(kind: str) -> SolverFusedXPBD:
    """One object at rest and strained by nothing, near the origin."""
    builder = new_builder()
    if kind == "cable":
        line = cable_line(CableConfig(), (-0.2, 0.0), (0.3, 0.1))
        add_cable(builder, CableConfig(), np.asarray(line) @ TURN)
    elif kind == "cloth":
        add_cloth(builder, ClothConfig(), cloth_sheet(ClothConfig(), (0.0, 0.0)) @ TURN)
    elif kind == "bag":
        add_bag(builder, BAG)
    else:
        add_box(builder, BoxConfig(), (0.0, 0.0, 0.0))
    return finalize(builder, precision="float32")


def velocities(solver: SolverFusedXPBD, kind: str, place: tuple[float, float, float]) -> np.ndarray:
    """Velocities (n, 3) [m/s] after `TIME` [s] from rest at `place`."""
    if kind == "box":
        x, v = solver.data.views["bodies.x"], solver.data.views["bodies.v"]
    else:
        x, v = solver.data.lane("particles.x", 0), solver.data.lane("particles.v", 0)
    if kind == "bag":
        x[:] = SHELL.vertices @ TURN
    x[:] = x + np.array(place, x.dtype)
    v[:] = 0.0
    solver.run(round(TIME / solver.config.dt))
    return np.asarray(v, dtype=float)


@pytest.mark.parametrize("kind", ["cable", "cloth", "bag", "box"])
@pytest.mark.parametrize("place", PLACES, ids=str)
def test_free_fall_far_from_the_origin(kind: str, place: tuple[float, float, float]) -> None:
    v = velocities(scene(kind), kind, place)
    # springs answer to lengths that are rounded out there: single particles do, their mean does not
    assert v[:, 2].mean() == pytest.approx(-G * TIME, rel=1e-3)
    assert np.abs(v.mean(axis=0)[:2]).max() < 1e-3 * G * TIME


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("lanes", [1, 8])
def test_a_free_particle_keeps_its_velocity_to_the_last_digits(lanes: int, precision: str) -> None:
    """Without air nothing but gravity changes it, however coarse the position is."""
    one, builder = new_builder(), new_builder()
    add_particles(one, [(24.0, -24.0, 24.0)], velocities=[(0.3, -0.2, 0.1)])
    builder.replicate(one, lanes)
    solver = finalize(builder, IDEAL, lanes=lanes, precision=precision)
    solver.run(round(TIME / solver.config.dt))
    for w in range(lanes):
        v = solver.data.lane("particles.v", w)[0]
        np.testing.assert_allclose(v, [0.3, -0.2, 0.1 - G * TIME], rtol=2e-5)
