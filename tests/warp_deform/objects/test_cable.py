"""Cables as objects: what their springs do, and what is refused."""

import math

import newton
import numpy as np
import pytest

from warp_deform.errors import InputError
from warp_deform.objects import CableConfig, RingConfig, add_cable, cable_line, cable_ring
from warp_deform.solver import SolverConfig, SolverFusedXPBD

MASS, BEADS = 0.002, 5


def _droop(bend_stiffness: float) -> float:
    """How far the free end of a cable clamped by its first two beads hangs down [m]."""
    config = CableConfig(
        beads=BEADS, mass=MASS, bend_stiffness=bend_stiffness, solve="gauss-seidel"
    )
    start = cable_line(config, (0.4, 0.0), (0.5, 0.0)) + np.array([0, 0, 0.5])
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    add_cable(builder, config, start)
    builder.particle_mass[0] = builder.particle_mass[1] = 0.0
    # one iteration a substep leaves an error of the order of dt^2 k / m, so the substep is short
    config = SolverConfig(dt=1 / 24000, damping=20.0)
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), config, precision="float64")
    solver.run(round(2 / config.dt))
    return float(start[-1, 2] - solver.data.lane("particles.x", 0)[-1, 2])


def test_a_cantilever_droops_like_a_beam() -> None:
    # joint j bends by M_j D / (E I), M_j the moment of the beads beyond it, E I = k D^3 / 4
    stiffness, spacing = 1e3, CableConfig().spacing
    place = spacing * np.arange(BEADS)
    droop = 0.0
    for j in range(1, BEADS - 1):
        moment = (MASS * 9.81 * (place[j + 1 :] - place[j])).sum()
        droop += moment * spacing / (stiffness * spacing**3 / 4) * (place[-1] - place[j])
    assert droop < 0.05 * place[-1]  # small enough for the linear theory
    assert _droop(stiffness) == pytest.approx(droop, rel=0.03)


def test_a_limp_cable_hangs_straight_down() -> None:
    assert _droop(0.0) == pytest.approx((BEADS - 2) * CableConfig().spacing, rel=0.01)


def test_a_ring_with_bending_springs_is_at_rest_when_round() -> None:
    config = RingConfig(bend_stiffness=1e3)
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    start = cable_ring(config, (0.5, 0.0))
    add_cable(builder, config, start)
    solver = SolverFusedXPBD(builder.finalize(device="cpu"))
    solver.run(600)
    assert np.abs(solver.data.lane("particles.x", 0) - start).max() < 1e-4


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"beads": 2}, "CableConfig.beads must be a whole number of at least 3"),
        ({"beads": 24.5}, "whole number"),
        ({"mass": math.inf}, "mass"),
        ({"radius": math.nan}, "radius"),
        ({"spacing": 0.0}, "spacing"),
        ({"fold_limit": 2.0}, "fold_limit"),
        ({"bend_stiffness": -1.0}, "bend_stiffness"),
    ],
)
def test_bad_configurations_are_refused_by_name(change: dict, named: str) -> None:
    with pytest.raises(InputError, match=named):
        CableConfig(**change)
