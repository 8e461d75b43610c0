"""The solver against closed forms: free motion, momentum, the pendulum, the hanging chain."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.solver_scenes import (
    G,
    add_particles,
    angular_momentum,
    box_solver,
    energy,
    finalize,
    frames,
    ideal,
    new_builder,
    positions,
    velocities,
)
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

from warp_deform.objects import BoxConfig, BoxPart, l_block
from warp_deform.solver import SolverFusedXPBD

DT = 1 / 1200
BRICK = BoxConfig(parts=(BoxPart((0.02, 0.05, 0.09)),), mass=0.2)


def lone_particle(damping: float, velocity: tuple[float, float, float]) -> SolverFusedXPBD:
    builder = new_builder()
    add_particles(builder, [(0.125, -0.25, 5.0)], velocities=[velocity])
    return finalize(builder, ideal(damping=damping))


@pytest.mark.parametrize("damping", [0.0, 1.0, 20.0])
def test_free_fall_follows_the_discrete_closed_form(damping):
    # v' = k (v + g dt), x' = x + v' dt, k = 1 - c dt: a geometric series in k
    steps = 600
    solver = lone_particle(damping, (0.5, 0.0, 0.0))
    solver.run(steps)
    k = 1 - damping * DT
    powers = k ** np.arange(1, steps + 1)
    tail = np.cumsum(powers)  # k + ... + k^n
    vz, z = -G * DT * tail[-1], 5.0 - G * DT**2 * tail.sum()
    x = 0.125 + 0.5 * DT * tail[-1]
    np.testing.assert_allclose(velocities(solver)[0], [0.5 * powers[-1], 0, vz], rtol=0, atol=1e-9)
    np.testing.assert_allclose(positions(solver)[0], [x, -0.25, z], rtol=0, atol=1e-10)


def test_a_damped_fall_approaches_terminal_speed():
    # continuous: v = g/c (1 - exp(-c t)); the scheme is of first order in dt
    solver, c, t = lone_particle(20.0, (0.0, 0.0, 0.0)), 20.0, 0.1
    solver.run(round(t / DT))
    exact = -G / c * (1 - np.exp(-c * t))
    assert velocities(solver)[0, 2] == pytest.approx(exact, rel=c * DT)


def test_a_projectile_flies_a_parabola():
    # x = x0 + v t, z = z0 + v t - g t (t + dt) / 2: the scheme's parabola, exact at every substep
    solver = lone_particle(0.0, (2.0, -1.0, 4.0))
    path = frames(solver, 600)[:, 0]
    t = np.arange(600)[:, None] * DT
    flight = np.array([[0.125, -0.25, 5.0]]) + t * [2.0, -1.0, 4.0] - t * (t + DT) * [0, 0, G / 2]
    np.testing.assert_allclose(path, flight, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (1.0, 2.0, -3.0)])
def test_bodies_and_particles_fall_alike(gravity):
    builder = new_builder()
    add_particles(builder, [(0.0, 0.0, 5.0)])
    particle = finalize(builder, ideal(damping=2.0), gravity=gravity)
    box = box_solver((BRICK, (0, 0, 5.0)), config=ideal(damping=2.0), gravity=gravity)
    for solver in (particle, box):
        solver.run(480)
    body_x = box.data.views["bodies.x"][0]
    np.testing.assert_allclose(body_x, positions(particle)[0], rtol=0, atol=1e-12)


def spinning_web(dt: float, seconds: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Relative change of linear and angular momentum of a free web of links, and energies."""
    rng = np.random.default_rng(3)
    x = np.add(rng.uniform(-0.1, 0.1, (5, 3)), (0, 0, 10))
    v = rng.uniform(-0.5, 0.5, (5, 3))
    mass = rng.uniform(0.05, 0.2, 5)
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)]
    builder = new_builder()
    links = [(i, j, float(np.linalg.norm(x[i] - x[j]))) for i, j in pairs]
    add_particles(builder, x, velocities=v, masses=mass, links=links, stiffness=1e3)
    solver = finalize(builder, ideal(dt=dt), gravity=0.0)
    mass = 1 / solver.data.lane("particles.w0", 0)

    def momenta() -> tuple[np.ndarray, np.ndarray]:
        x, p = positions(solver), mass[:, None] * velocities(solver)
        return p.sum(0), np.cross(x - (mass @ x) / mass.sum(), p).sum(0)

    linear, angular = momenta()
    before = energy(solver, gravity=0.0)
    solver.run(round(seconds / dt))
    after_linear, after_angular = momenta()
    return (
        after_linear - linear,
        np.linalg.norm(after_angular - angular) / np.linalg.norm(angular),
        before,
        energy(solver, gravity=0.0),
    )


def test_links_conserve_momentum_and_add_no_energy():
    # internal forces are pairwise: linear momentum to rounding; angular momentum to order dt, as a
    # link corrects along its direction after the step and not before
    changes = []
    for dt in (1 / 1200, 1 / 2400, 1 / 4800):
        linear, angular, before, after = spinning_web(dt, 0.25)
        np.testing.assert_allclose(linear, 0, atol=1e-10)
        assert after < before
        changes.append(angular)
    assert changes[0] < 0.02
    assert changes[2] < 0.35 * changes[0]


@pytest.mark.parametrize("config", [BRICK, l_block()], ids=["brick", "l-block"])
def test_a_tumbling_box_keeps_momentum_and_energy(config):
    # Euler's equations by the midpoint rule: spin and energy are kept to dt^2, the axis to dt
    def tumble(dt: float) -> tuple[float, float, float]:
        solver = box_solver((config, (0, 0, 5)), config=ideal(dt=dt), gravity=0.0)
        views = solver.data.views
        views["bodies.v"][0] = 0.3, -0.2, 0.1
        views["bodies.omega"][0] = 1.0, 8.0, 0.5
        spin, start, x = (
            angular_momentum(solver)[0],
            energy(solver, gravity=0.0),
            views["bodies.x"].copy(),
        )
        solver.run(round(1.0 / dt))
        np.testing.assert_allclose(views["bodies.v"][0], [0.3, -0.2, 0.1], rtol=0, atol=1e-11)
        np.testing.assert_allclose(views["bodies.x"] - x, [[0.3, -0.2, 0.1]], rtol=0, atol=1e-11)
        now = angular_momentum(solver)[0]
        size = np.linalg.norm(spin)
        return (
            abs(np.linalg.norm(now) / size - 1),
            float(np.linalg.norm(now - spin) / size),
            abs(energy(solver, gravity=0.0) / start - 1),
        )

    coarse, fine = tumble(1 / 600), tumble(1 / 1200)
    assert coarse[0] < 1e-5 and coarse[2] < 1e-5
    assert fine[0] < 0.35 * coarse[0] and fine[2] < 0.35 * coarse[2]
    assert coarse[1] < 8.0 / 600 and fine[1] < 0.6 * coarse[1]


def test_a_box_that_spins_about_a_main_axis_turns_at_that_rate():
    # angle = omega t; a substep turns by 2 atan(omega dt / 2), which is low by (omega dt)^2 / 12
    omega, seconds = 20.0, 0.1
    solver = box_solver((BRICK, (0, 0, 5)), gravity=0.0)
    views = solver.data.views
    views["bodies.omega"][0] = 0, 0, omega
    solver.run(round(seconds / DT))
    angle = 2 * np.arctan2(views["bodies.q"][0, 2], views["bodies.q"][0, 3])
    assert angle == pytest.approx(omega * seconds, rel=(omega * DT) ** 2 / 6)
    assert views["bodies.omega"][0, 2] == pytest.approx(omega, rel=1e-12)


LENGTH, SWING = 0.3, 0.5


def pendulum(dt: float, seconds: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, angles [rad] and energy lost of a bead on a link to a pinned particle."""
    builder = new_builder()
    bob = (LENGTH * np.sin(SWING), 0.0, 1 - LENGTH * np.cos(SWING))
    add_particles(builder, [(0, 0, 1), bob], masses=[0, 0.1], links=[(0, 1, LENGTH)])
    solver = finalize(builder, ideal(dt=dt))
    before = energy(solver)
    path = frames(solver, round(seconds / dt))[:, 1]
    angle = np.arctan2(path[:, 0], 1 - path[:, 2])
    return np.arange(len(path)) * dt, angle, before - energy(solver)


def test_the_pendulum_has_its_period():
    # T = 4 sqrt(L/g) K(sin(swing / 2)), K the complete elliptic integral: 1.6 % above the small-
    # swing 2 pi sqrt(L/g)
    exact = 4 * np.sqrt(LENGTH / G) * ellipk(np.sin(SWING / 2) ** 2)
    t, angle, lost = pendulum(DT, 2.5)
    k = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossings = t[k] + DT * angle[k] / (angle[k] - angle[k + 1])
    # implicit steps damp the swing at a rate of order dt, and a smaller swing is faster
    assert np.diff(crossings)[0] == pytest.approx(exact, rel=1.0 * DT)
    assert lost > 0


def test_positions_converge_with_the_first_order_of_dt():
    # phi'' = -g/L sin(phi), integrated to 1e-10
    seconds, steps = 0.5, np.array([1 / 600, 1 / 1200, 1 / 2400])
    exact = solve_ivp(
        lambda _, y: [y[1], -G / LENGTH * np.sin(y[0])],
        (0, 1),
        [SWING, 0],
        rtol=1e-11,
        atol=1e-12,
        dense_output=True,
    ).sol
    errors = []
    for dt in steps:
        t, angle, _ = pendulum(dt, seconds)
        errors.append(np.abs(angle - exact(t)[0]).max())
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert (slopes > 0.9).all() and errors[-1] < 0.005, (slopes, errors)


def test_springs_converge_to_hooke():
    # z'' = -k/m z - g: amplitude m g / k about the rest length, period 2 pi sqrt(m / k)
    stiffness, mass, rest = 50.0, 0.1, 0.2
    period = 2 * np.pi * np.sqrt(mass / stiffness)
    errors = []
    for dt in (1 / 2400, 1 / 4800, 1 / 9600):
        builder = new_builder()
        add_particles(
            builder,
            [(0, 0, 1), (0, 0, 1 - rest)],
            masses=[0, mass],
            links=[(0, 1, rest)],
            stiffness=stiffness,
        )
        path = frames(finalize(builder, ideal(dt=dt)), round(period / dt))[:, 1, 2]
        t = np.arange(len(path)) * dt
        exact = 1 - rest - mass * G / stiffness * (1 - np.cos(np.sqrt(stiffness / mass) * t))
        errors.append(np.abs(path - exact).max() / (mass * G / stiffness))
    assert errors[0] < 0.03
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1], errors


BEADS, SPAN, LINK = 25, 0.5, 0.025


def chain_shape() -> np.ndarray:
    """Beads (n, 2) of the exact hanging chain of point masses between two nails at the same height.

    Link i pulls with horizontal force 1 and vertical force w (i - (n - 2) / 2); one unknown w.
    """
    rank = np.arange(BEADS - 1) - (BEADS - 2) / 2

    def links(w: float) -> np.ndarray:
        slope = w * rank
        return LINK / np.hypot(1, slope)[:, None] * np.column_stack([np.ones_like(slope), slope])

    w = brentq(lambda w: links(w)[:, 0].sum() - SPAN, 1e-3, 10)
    return np.vstack([[0, 0], np.cumsum(links(w), axis=0)])


def test_a_hanging_chain_is_a_catenary():
    start = np.zeros((BEADS, 3))
    start[:, 0] = np.linspace(0, SPAN, BEADS)
    start[:, 2] = 1 - 0.1 * np.sin(np.pi * start[:, 0] / SPAN)
    masses = np.full(BEADS, 0.01)
    masses[[0, -1]] = 0
    errors = []
    for dt in (1 / 2400, 1 / 4800):
        builder = new_builder()
        links = [(i, i + 1, LINK) for i in range(BEADS - 1)]
        add_particles(builder, start, masses=masses, links=links)
        solver = finalize(builder, ideal(dt=dt, damping=8.0))
        solver.run(round(2.5 / dt))
        assert np.abs(velocities(solver)).max() < 1e-3
        shape = positions(solver)[:, [0, 2]] - [0, 1]
        errors.append(np.linalg.norm(shape - chain_shape(), axis=1).max())
    # one sweep a substep leaves a stretch of order n^2 g dt^2, from the nails inwards
    assert errors[0] < 0.5 * BEADS**2 * G / 2400**2
    assert errors[1] < 0.35 * errors[0], errors


def test_the_exact_chain_tends_to_the_cosh():
    # y = a (cosh(x / a) - cosh(s / 2a)), length 2 a sinh(s / 2a): differs by order 1 / n^2
    length = LINK * (BEADS - 1)
    a = brentq(lambda a: 2 * a * np.sinh(SPAN / 2 / a) - length, 0.05, 10)
    x, y = chain_shape().T
    curve = a * (np.cosh((x - SPAN / 2) / a) - np.cosh(SPAN / 2 / a))
    np.testing.assert_allclose(y, curve, rtol=0, atol=length / BEADS**2)
