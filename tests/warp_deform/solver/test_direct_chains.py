"""Chains and beams solved directly: closed forms at the default substep, and the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from fixtures.solver_scenes import LOOSE, G, add_particles, finalize, ideal, new_builder
from scipy.optimize import brentq

from warp_deform.errors import InputError
from warp_deform.objects import CableConfig, add_cable, cable_line
from warp_deform.objects.attributes import SpringMode, attribute
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.xpbd.packing.topology import runs

LONG = CableConfig(beads=200)


def elastic_catenary(cable: CableConfig, span: float) -> np.ndarray:
    """Beads (n, 2) of the exact chain of point masses and elastic links between two nails.

    Link k pulls with the horizontal force H and the vertical one m g (k - (n - 2) / 2), and is
    longer by that pull over its stiffness; one unknown H.
    """
    weight = cable.mass * G * (np.arange(cable.beads - 1) - (cable.beads - 2) / 2)

    def links(h: float) -> np.ndarray:
        pull = np.hypot(h, weight)
        along = np.column_stack([np.full_like(pull, h), weight]) / pull[:, None]
        return along * (cable.spacing + pull / cable.link_stiffness)[:, None]

    h = brentq(lambda h: links(h)[:, 0].sum() - span, 1e-6, 1e5)
    return np.vstack([[0.0, 0.0], np.cumsum(links(h), axis=0)])


def settled_between_nails(cable: CableConfig, span: float) -> np.ndarray:
    """Beads (n, 2) after 6 s from the catenary of rigid links, in air that slows them."""
    rigid = elastic_catenary(replace(cable, link_stiffness=1e12), span)
    start = np.column_stack([rigid[:, 0], np.zeros(len(rigid)), rigid[:, 1] + 4.0])
    builder = new_builder()
    add_cable(builder, cable, start)
    builder.particle_mass[0] = builder.particle_mass[cable.beads - 1] = 0.0
    solver = finalize(builder, ideal(dt=SolverConfig().dt, damping=4.0), precision="float32")
    solver.run(7200)
    assert np.abs(solver.particle_qd(0)).max() < 2e-3
    return solver.particle_q(0)[:, [0, 2]] - [0.0, 4.0]


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_a_cable_of_200_beads_hangs_as_the_elastic_catenary(share: float) -> None:
    span = share * (LONG.beads - 1) * LONG.spacing
    shape, exact = settled_between_nails(LONG, span), elastic_catenary(LONG, span)
    sag = -exact[:, 1].min()
    assert -shape[:, 1].min() == pytest.approx(sag, rel=2e-3)
    assert np.linalg.norm(shape - exact, axis=1).max() < 2e-3 * sag


def test_one_link_after_the_other_it_would_sag_by_far_more() -> None:
    span = 0.95 * (LONG.beads - 1) * LONG.spacing
    shape = settled_between_nails(replace(LONG, solve="gauss-seidel"), span)
    assert shape[:, 1].min() < 1.3 * elastic_catenary(LONG, span)[:, 1].min()


def droop(cable: CableConfig, precision: str) -> float:
    """How far the free end of a cable clamped by its first two beads hangs down [m]."""
    start = cable_line(cable, (0.4, 0.0), (0.5, 0.0)) + np.array([0, 0, 1.0])
    builder = new_builder()
    add_cable(builder, cable, start)
    builder.particle_mass[0] = builder.particle_mass[1] = 0.0
    solver = finalize(builder, ideal(dt=SolverConfig().dt, damping=4.0), precision=precision)
    solver.run(6000)
    assert np.abs(solver.particle_qd(0)).max() < 2e-3
    return float(start[-1, 2] - solver.particle_q(0)[-1, 2])


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    ("beads", "stiffness", "mass"), [(5, 1e3, 0.002), (24, 6e6, 0.1), (100, 4e8, 0.1)]
)
def test_a_cantilever_droops_like_a_beam_at_the_default_substep(
    beads: int, stiffness: float, mass: float, precision: str
) -> None:
    cable = CableConfig(beads=beads, mass=mass, bend_stiffness=stiffness)
    place = cable.spacing * np.arange(beads)
    # joint j bends by M_j D / (E I), M_j the moment of the beads beyond it, E I = k D^3 / 4
    moment = [mass * G * (place[j + 1 :] - place[j]).sum() for j in range(1, beads - 1)]
    bends = np.array(moment) * cable.spacing / (stiffness * cable.spacing**3 / 4)
    exact = float(bends @ (place[-1] - place[1:-1]))
    assert exact < 0.09 * place[-1], "small enough for the linear theory"
    assert droop(cable, precision) == pytest.approx(exact, rel=0.01)


def test_cables_of_the_tasks_are_solved_one_link_after_the_other() -> None:
    assert not CableConfig().solved_directly
    assert not CableConfig(bend_stiffness=2.0).solved_directly
    assert CableConfig(beads=50).solved_directly, "too heavy"
    assert CableConfig(bend_stiffness=2e4).solved_directly, "too stiff"
    assert not CableConfig(beads=50, solve="gauss-seidel").solved_directly
    assert CableConfig(solve="direct").solved_directly
    with pytest.raises(InputError, match=r"CableConfig.solve must be one of direct, gauss-seidel"):
        CableConfig(solve="jacobi")


def cables(worlds: int, lanes: int, precision: str) -> SolverFusedXPBD:
    cable = CableConfig(beads=12, bend_stiffness=20.0, solve="direct")
    one, builder = new_builder(), new_builder()
    add_cable(one, cable, cable_line(cable, (0.4, 0.0), (0.6, 0.0)))
    builder.replicate(one, worlds)
    model, config = builder.finalize(device="cpu"), SolverConfig(limits=LOOSE, max_speed=1e3)
    return SolverFusedXPBD(model, config, lanes=lanes, precision=precision)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_bits_do_not_depend_on_lanes(precision: str) -> None:
    def crumple(solver: SolverFusedXPBD, world: int, seed: int) -> None:
        x = solver.data.lane("particles.x", world)
        x += np.random.default_rng(seed).normal(0, 5e-3, x.shape)
        x[:, 2] += 0.03

    together = cables(5, 8, precision)
    for world in range(5):
        crumple(together, world, world)
        together.set_world(world, stiffness=1.0 + world)
    together.run(300)
    for world in range(5):
        alone = cables(1, 1, precision)
        crumple(alone, 0, world)
        alone.set_world(0, stiffness=1.0 + world)
        alone.run(300)
        assert np.isfinite(alone.particle_q(0)).all()
        assert np.array_equal(alone.particle_q(0), together.particle_q(world))
        assert np.array_equal(alone.particle_qd(0), together.particle_qd(world))


def test_momentum_is_conserved() -> None:
    solver = cables(1, 1, "float64")
    solver.data.per_world("group.damping", 0)[:] = 0.0
    solver.data.per_world("group.gravity", 0)[:] = 0.0
    x, v = solver.data.lane("particles.x", 0), solver.data.lane("particles.v", 0)
    rng = np.random.default_rng(3)
    x += rng.normal(0, 1e-3, x.shape)
    x[:, 2] += 1.0
    v += rng.normal(0, 0.05, v.shape)
    before = v.sum(axis=0)
    solver.run(10)
    np.testing.assert_allclose(solver.particle_qd(0).sum(axis=0), before, rtol=0, atol=1e-9)


def test_a_run_goes_on_where_a_spring_ended_and_meets_no_particle_twice() -> None:
    chain, equal, beam = int(SpringMode.CHAIN), int(SpringMode.EQUAL), int(SpringMode.BEAM)
    ring = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7]])
    mode = np.array([chain] * 6 + [equal])
    assert runs(ring, np.full(7, -1), mode).tolist() == [3, 0, 0, 1, 2, 0, 1]
    bent = np.array([[0, 2], [1, 3], [2, 4], [3, 5]])
    middle = np.array([1, 2, 3, 9])
    assert runs(bent, middle, np.full(4, beam)).tolist() == [3, 0, 0, 1]


def test_a_beam_has_no_offset() -> None:
    builder = new_builder()
    add_particles(builder, [[0, 0, 1], [0.1, 0, 1], [0.2, 0, 1]], links=[(0, 2, 0.1)])
    builder.custom_attributes[attribute("spring_mode")].values = {0: int(SpringMode.BEAM)}
    builder.custom_attributes[attribute("spring_middle")].values = {0: 1}
    with pytest.raises(InputError, match="a BEAM spring needs rest length 0"):
        finalize(builder)


@pytest.mark.parametrize("mode", [-1, len(SpringMode)])
def test_a_mode_that_there_is_not_is_refused(mode: int) -> None:
    builder = new_builder()
    add_particles(builder, [[0, 0, 1], [0.1, 0, 1]], links=[(0, 1, 0.1)])
    builder.custom_attributes[attribute("spring_mode")].values = {0: mode}
    with pytest.raises(InputError, match=f"there is no spring_mode {mode}; there are: 0 EQUAL"):
        finalize(builder)
