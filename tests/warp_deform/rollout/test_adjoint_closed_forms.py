"""Derivatives of a sliding stop, a pendulum, a pushed box and single particles in closed form.

The first three twice: of the discrete scheme, written out for one coordinate and differentiated by
complex steps (Squire, Trapp, SIAM Review 40(1), 1998), to 1e-5; and of the continuous problem,
whose error halves with the substep. Of a pendulum, the angle is varied: lengths of springs are no
parameters.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fixtures.solver_scenes import G, add_particles, box_solver, finalize, ideal, new_builder
from scipy.special import ellipj, ellipk

from warp_deform.objects import BoxConfig, add_box
from warp_deform.objects.box import BoxPart
from warp_deform.rollout import DifferentiableRollout, Gradients, GripPath
from warp_deform.xpbd.bodies.rigid_body import SLEEP_SPEED

pytestmark = pytest.mark.in_a_row("adjoints")

DT = 1 / 1200
MU = 0.4
SPEED = 0.6
FLAT = BoxConfig(parts=(BoxPart((0.08, 0.08, 0.02)),), mass=0.05)
"""Lies so flat that friction at its base hardly loads its front."""


def slope(f: Callable[[complex], complex], at: float) -> float:
    """Derivative of an analytic function, exact to rounding."""
    return f(at + 1e-30j).imag / 1e-30


def evenly(count: int, least: float = 0.0) -> float:
    """Substep such that slowing from SPEED to `least` takes so many and a quarter: refined at the
    same phase, the scheme's error is a power of the substep.
    """
    return (SPEED - least) / (MU * G) / (count + 0.25)


def assert_first_order(coarse: np.ndarray, fine: np.ndarray, exact: np.ndarray) -> None:
    """Errors halve with the substep, and the finer ones are below 2 %."""
    errors = np.abs(coarse - exact), np.abs(fine - exact)
    assert (errors[1] < 0.02 * np.abs(exact)).all()
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


# -- stopping by friction


def stop_of_particle(dt: float, seconds: float = 0.25) -> tuple[float, float, float]:
    """Way, and its slopes by speed and by friction."""
    builder = new_builder()
    add_particles(builder, [[0.0, 0.0, 0.005]], velocities=[[SPEED, 0.0, 0.0]])
    solver = finalize(builder, ideal(table_friction=MU, dt=dt))
    run = DifferentiableRollout(solver)
    end = run.forward([0], [seconds])[0, 0, 0, 0]
    gradients = run.backward(np.array([[[[1.0, 0.0, 0.0]]]]))
    return end, gradients.velocities[0, 0, 0], gradients.table_friction[0]


def stop_of_box(dt: float, seconds: float = 0.25) -> tuple[float, float, float]:
    solver = box_solver((FLAT, (0, 0, 0.01)), config=ideal(table_friction=MU, dt=dt))
    poses, _ = solver.data.body_poses(0)
    solver.data.set_bodies(0, poses, np.array([[SPEED, 0, 0, 0, 0, 0]]))
    run = DifferentiableRollout(solver)
    run.forward([0], [seconds])
    gradients = run.backward(bodies=np.array([[[[1.0, 0, 0, 0, 0, 0, 0]]]]))
    end = run.body_poses[0, 0, 0, 0]
    return end, gradients.body_velocities[0, 0, 0], gradients.table_friction[0]


def sliding_way(speed: complex, mu: complex, dt: float) -> complex:
    """A particle's: what is left of a step d with the budget b is 1 - b / (d^4 + b^4)^(1/4)."""
    way, v, budget = 0.0, speed, mu * G * dt**2
    for _ in range(round(0.25 / dt)):
        d = v * dt
        d *= 1 - budget / (d**4 + budget**4) ** 0.25
        way, v = way + d, d / dt
    return way


def sliding_way_of_box(speed: complex, mu: complex, dt: float) -> complex:
    """A box's: every substep takes mu g dt of its speed, until it is slow enough to sleep."""
    way, v = 0.0, speed - mu * G * dt
    while v.real >= SLEEP_SPEED:
        way, v = way + v * dt, v - mu * G * dt
    return way


@pytest.mark.parametrize(
    ("simulate", "scheme"), [(stop_of_particle, sliding_way), (stop_of_box, sliding_way_of_box)]
)
def test_stop_by_friction(simulate: Callable, scheme: Callable) -> None:
    end, by_speed, by_mu = simulate(DT)
    assert end == pytest.approx(scheme(SPEED, MU, DT), rel=1e-5)
    assert by_speed == pytest.approx(slope(lambda v: scheme(v, MU, DT), SPEED), rel=1e-5)
    assert by_mu == pytest.approx(slope(lambda mu: scheme(SPEED, mu, DT), MU), rel=1e-5)


@pytest.mark.parametrize(("simulate", "least"), [(stop_of_particle, 0), (stop_of_box, SLEEP_SPEED)])
def test_stop_by_friction_is_of_first_order(simulate: Callable, least: float) -> None:
    """A box sleeps from `least` speed on. When it does is a branch, and held: its derivatives are
    of the way to a given time, and less than those of the whole way by what sleep cuts off.
    """
    way, drop = (SPEED**2 - least**2) / (2 * MU * G), MU * G
    held = np.array([way, (SPEED - least) / drop, -((SPEED - least) ** 2) / (2 * drop * MU)])
    coarse, fine = (np.array(simulate(evenly(count, least))) for count in (180, 360))
    assert_first_order(coarse, fine, held)
    assert fine == pytest.approx(np.array([way, SPEED / drop, -way / MU]), rel=0.02)


# -- a pendulum

LENGTH = 0.3
ANGLE = 0.9
STIFF = 1e7


def pendulum(dt: float, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and velocity of the bob, and the slopes of its angle and position by the start's."""
    builder, mass = new_builder(), 0.1
    top = np.array([0.0, 0.0, 1.0])
    arm = LENGTH * np.array([np.sin(ANGLE), 0.0, -np.cos(ANGLE)])
    add_particles(
        builder, [top, top + arm], masses=[0.0, mass], links=[(0, 1, LENGTH)], stiffness=STIFF
    )
    solver = finalize(builder, ideal(dt=dt))
    run = DifferentiableRollout(solver)
    end = run.forward([0], [seconds])[0, 0, 1]
    turned = LENGTH * np.array([np.cos(ANGLE), 0.0, np.sin(ANGLE)])  # of the bob by the angle
    slopes = np.zeros(3)
    for axis in (0, 2):
        by_end = np.zeros((1, 1, 2, 3))
        by_end[..., 1, axis] = 1.0
        slopes[axis] = run.backward(by_end).positions[0, 1] @ turned
    return end - top, solver.particle_qd(0)[1], slopes


def swung(angle: complex, dt: float, seconds: float) -> np.ndarray:
    """The scheme with one spring: the bob's x and z from the pin."""
    x = LENGTH * np.array([np.sin(angle), -np.cos(angle)])
    v = np.zeros(2, dtype=complex)
    w = 10.0
    for _ in range(round(seconds / dt)):
        to = x + (v + np.array([0.0, -G]) * dt) * dt
        length = np.sqrt((to**2).sum())
        s = (length - LENGTH) / ((w + 1e-9 + 1 / (STIFF * dt**2)) * length)
        to = to * (1 - s * w)
        x, v = to, (to - x) / dt
    return x


def swing(angle: float, seconds: float) -> float:
    """Angle of an ideal pendulum."""
    k = np.sin(angle / 2)
    phase = ellipk(k**2) - np.sqrt(G / LENGTH) * seconds
    return 2 * np.arcsin(k * ellipj(phase, k**2)[0])


def test_pendulum() -> None:
    end, _, slopes = pendulum(DT, 0.5)
    assert end[[0, 2]] == pytest.approx(swung(ANGLE, DT, 0.5).real, rel=1e-5)
    exact = swung(ANGLE + 1e-30j, DT, 0.5).imag / 1e-30
    assert slopes[[0, 2]] == pytest.approx(exact, rel=1e-5)


def test_pendulum_is_of_first_order() -> None:
    """Position and period by the angle that it starts at."""
    seconds, h = 0.4, 1e-5
    at = swing(ANGLE, seconds)
    by_angle = (swing(ANGLE + h, seconds) - swing(ANGLE - h, seconds)) / (2 * h)
    exact = LENGTH * by_angle * np.array([np.cos(at), np.sin(at)])
    coarse, fine = (pendulum(seconds / n, seconds)[2][[0, 2]] for n in (960, 1920))
    assert_first_order(coarse, fine, exact)

    # at a quarter of the period the bob hangs: dT / 4 is what its way is behind, over its speed
    quarter = ellipk(np.sin(ANGLE / 2) ** 2) * np.sqrt(LENGTH / G)
    of_period = [np.sqrt(LENGTH / G) * ellipk(np.sin((ANGLE + s) / 2) ** 2) * 4 for s in (h, -h)]
    slopes_of_period = []
    for n in (960, 1920):
        _, velocity, slopes = pendulum(quarter / n, quarter)
        slopes_of_period.append(-4 * slopes[0] / velocity[0])
    exact_period = np.array([(of_period[0] - of_period[1]) / (2 * h)])
    assert_first_order(
        np.array([slopes_of_period[0]]), np.array([slopes_of_period[1]]), exact_period
    )


# -- a pushed box

RADIUS = 0.005
HALF = 0.04
PUSHED = 0.3
"""Speed of the push [m/s]."""
SLIDE = (PUSHED - SLEEP_SPEED) / (MU * G)
LONG = 3 * SLIDE
"""How long it pushes, and how long the box slides on until it sleeps [s]: in step, see `evenly`."""
PUSH = PUSHED * LONG


def pushed(dt: float, seconds: float) -> tuple[float, Gradients]:
    """A held bead pushes a box PUSH [m] far in LONG [s] and stops, the box slides on: where the box
    ends along x, and the derivatives of that.
    """
    builder = new_builder()
    add_box(builder, FLAT, (0.0, 0.0, 0.01))
    start = np.array([-HALF - RADIUS, 0.0, 0.01])
    add_particles(builder, [start], colliding=True, masses=0.01, radius=RADIUS)
    config = ideal(table_friction=MU, contact_friction=0.0, dt=dt)
    solver = finalize(builder, config)
    run = DifferentiableRollout(solver)
    # it is led on to where it stopped, so that it does not fall in the way
    knots = start + np.array([[0, 0, 0], [PUSH, 0, 0], [PUSH, 0, 0]])
    path = GripPath(np.array([0.0, LONG, seconds + 0.1]), knots, particle=0)
    run.forward([0], [seconds], paths={0: path})
    gradients = run.backward(bodies=np.array([[[[1.0, 0, 0, 0, 0, 0, 0]]]]))
    return run.body_poses[0, 0, 0, 0], gradients


def shoved(push: complex, long: complex, dt: float, seconds: float) -> complex:
    """The scheme along x: the bead, then the table."""
    x, v = 0.0, 0.0
    last = 0.0
    for tick in range(1, round(seconds / dt) + 1):
        clock = tick * dt
        bead = push * clock / long if clock < np.real(long) else push
        to = x + v * dt
        overlap, before = bead - to, last - x
        if np.real(overlap) > 0:
            # of an overlap that the substep began with, most stays
            inside = np.real(before) > 0
            left = max(before - ideal().recovery * dt, 0.8 * before, key=np.real) if inside else 0
            to += overlap - left if np.real(overlap) > np.real(left) else 0
        step, budget = to - x, MU * G * dt**2
        step = step - budget if np.real(step) > np.real(budget) else 0.0 * step
        if np.real(step) >= SLEEP_SPEED * dt:
            x = x + step
        v, last = step / dt, bead
    return x


def test_pushed_box() -> None:
    seconds = 0.33
    end, gradients = pushed(DT, seconds)
    assert end == pytest.approx(np.real(shoved(PUSH, LONG, DT, seconds)), rel=1e-5)
    by_way = slope(lambda push: shoved(push, LONG, DT, seconds), PUSH)
    by_time = slope(lambda long: shoved(PUSH, long, DT, seconds), LONG)
    ways = gradients.waypoints[0][:, 0]
    assert ways[1] + ways[2] == pytest.approx(by_way, rel=1e-5)
    assert gradients.knot_times[0][1] == pytest.approx(by_time, rel=1e-5)


def test_pushed_box_is_of_first_order() -> None:
    """It ends v^2 / (2 mu g) beyond the bead, with v = way / time.

    When it leaves the bead, and when it sleeps, are branches, and held: the derivative by time
    lacks that a longer push goes on for longer.
    """
    drop, least = MU * G, SLEEP_SPEED
    end = PUSH + (PUSHED**2 - least**2) / (2 * drop)
    held = np.array([end, 1 + SLIDE / LONG, -PUSHED - PUSHED * SLIDE / LONG])
    of_steps = []
    for count in (90, 180):
        stop, gradients = pushed(SLIDE / (count + 0.25), 0.33)
        ways = gradients.waypoints[0][:, 0]
        of_steps.append(np.array([stop, ways[1] + ways[2], gradients.knot_times[0][1]]))
    assert_first_order(*of_steps, held)
    assert of_steps[1][1] == pytest.approx(1 + PUSHED / (drop * LONG), rel=0.01)


# -- a particle that slides, hangs or falls


def test_stopping_distance_of_a_sliding_particle() -> None:
    """The way v^2 / (2 mu g) has slopes v / (mu g) and -s / mu."""
    builder, mu, speed = new_builder(), 0.4, 0.6
    add_particles(builder, [[0.0, 0.0, 0.005]], velocities=[[speed, 0.0, 0.0]])
    solver = finalize(builder, ideal(table_friction=mu), precision="float64")
    run = DifferentiableRollout(solver)
    end = run.forward([0], [0.3])[0, 0, 0, 0]
    gradients = run.backward(np.array([[[[1.0, 0.0, 0.0]]]]))
    assert end == pytest.approx(speed**2 / (2 * mu * G), rel=0.01)
    assert gradients.velocities[0, 0, 0] == pytest.approx(speed / (mu * G), rel=0.02)
    assert gradients.table_friction[0] == pytest.approx(-end / mu, rel=0.02)
    assert gradients.positions[0, 0, 0] == pytest.approx(1.0, rel=1e-9)


def test_mass_and_stiffness_of_a_hanging_particle() -> None:
    """It rests m g / k below its pin: slopes g / k by mass, -m g / k by the factor on stiffness."""
    builder, mass, stiffness, rest, drag = new_builder(), 0.1, 100.0, 0.2, 30.0
    pull = G * (1 - drag * DT)  # drag slows what a substep adds, too
    add_particles(
        builder,
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.79]],
        masses=[0.0, mass],
        links=[(0, 1, rest)],
        stiffness=stiffness,
    )
    solver = finalize(builder, ideal(damping=drag), precision="float64")
    run = DifferentiableRollout(solver)
    end = run.forward([0], [1.5])
    gradients = run.backward(np.array([[[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]]))
    assert end[0, 0, 1, 2] == pytest.approx(1.0 - rest - mass * pull / stiffness, abs=1e-5)
    by_mass = -gradients.inverse_masses[0, 1] / mass**2
    assert by_mass == pytest.approx(-pull / stiffness, rel=1e-3)
    assert gradients.stiffness[0] == pytest.approx(mass * pull / stiffness, rel=1e-3)
    # the pin carries it
    assert gradients.positions[0, 0, 2] == pytest.approx(1.0, rel=1e-3)
    assert gradients.inverse_masses[0, 0] == 0.0


def test_fall_through_air() -> None:
    """With drag d, where a body falls to and its slopes are closed forms."""
    builder, drag, end = new_builder(), 2.0, 0.5
    add_particles(builder, [[0.0, 0.0, 5.0]])
    solver = finalize(builder, ideal(damping=drag), precision="float64")
    run = DifferentiableRollout(solver)
    run.forward([0], [end])
    gradients = run.backward(np.array([[[[0.0, 0.0, 1.0]]]]))
    decay = np.exp(-drag * end)
    fallen = G / drag**2 * (decay - 1 + drag * end)
    by_drag = -2 * fallen / drag + G / drag**2 * (end - end * decay)
    assert gradients.damping[0] == pytest.approx(-by_drag, rel=1e-2)
    assert gradients.velocities[0, 0, 2] == pytest.approx((1 - decay) / drag, rel=5e-3)
