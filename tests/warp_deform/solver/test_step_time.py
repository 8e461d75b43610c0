"""`SolverFusedXPBD.step` simulates the time that it is asked for, or refuses it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import G, add_particles, finalize, ideal, new_builder

from warp_deform.errors import InputError
from warp_deform.objects.push import Push
from warp_deform.rollout import rollout
from warp_deform.solver import (
    PhysicsError,
    ProblemKind,
    SolverConfig,
    SolverFusedXPBD,
    replay_bundle,
)
from warp_deform.solver.stepping import FINEST, substeps
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER

USUAL = SolverConfig().dt
WRONG = [0, 0.0, -1 / 60, np.nan, np.inf, -np.inf, "1/60", None, True, 1j, [1 / 60],
         np.array([1 / 60]), np.array(1 / 60), 1e-9, 1e6]  # fmt: skip


def falling(config: SolverConfig | None = None, **options) -> SolverFusedXPBD:
    """Four worlds with one particle each at 0.1 m, without air."""
    one, builder = new_builder(), new_builder()
    add_particles(one, [(0, 0, 0.1)])
    builder.replicate(one, 4)
    return finalize(builder, config or ideal(), **options)


@pytest.mark.parametrize("dt", WRONG, ids=repr)
def test_a_time_that_is_none_is_refused_and_changes_nothing(dt):
    solver = falling()
    state, after = solver.model.state(), solver.model.state()
    before = after.particle_q.numpy().copy()
    with pytest.raises(InputError, match="dt"):
        solver.step(state, after, None, None, dt)
    np.testing.assert_array_equal(after.particle_q.numpy(), before)


@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize(
    "dt", [1 / 60, 1 / 60 / 32, 1 / 240, 1e-4, 0.0011, 0.09, np.float32(1 / 60), Fraction(1, 70)]
)
def test_free_fall_lasts_as_long_as_asked(dt, lanes):
    solver = falling(lanes=lanes)
    state, after = solver.model.state(), solver.model.state()
    count = max(1, round(0.1 / float(dt)))
    for _ in range(count):
        solver.step(state, after, None, None, dt)
        state, after = after, state
    time = count * float(dt)
    _, substep = substeps(dt, USUAL)
    fallen = 0.1 - state.particle_q.numpy()[:, 2]
    # the scheme's own t (t + h) / 2; the state between steps is float32
    np.testing.assert_allclose(fallen, G / 2 * time * (time + substep), rtol=1e-3)
    np.testing.assert_allclose(state.particle_qd.numpy()[:, 2], -G * time, rtol=1e-3)


def test_substeps_are_equal_and_no_longer_than_configured():
    rng = np.random.default_rng(0)
    for dt in USUAL * FINEST * (1 + 100 * rng.random(2000) ** 4):
        count, length = substeps(dt, USUAL)
        assert count * length == pytest.approx(dt, rel=1e-5)
        assert USUAL * FINEST * (1 - 1e-5) <= length <= USUAL
    for count in (1, 2, 20, 1000):
        assert substeps(np.float32(count * USUAL), USUAL) == (count, USUAL)


def test_parameters_per_second_hold_at_an_adapted_substep():
    """Air and the viscosity of a fabric that moves take as much in as long a time."""
    config = SolverConfig(damping=2.0, viscosity=30.0, max_speed=100.0)
    ends = {}
    for dt in (1 / 60, 1 / 60 / 32, 1 / 60 / 50):
        solver, _ = cloth_solver(SMALL, height=1.0, config=config, precision="float64")
        solver.data.views["group.gravity"][...] = 0.0
        state, after = solver.model.state(), solver.model.state()
        speed = state.particle_qd.numpy()
        speed[:, 0] = 1.0 + np.arange(len(speed)) % 2 * 0.1
        state.particle_qd.assign(speed)
        for _ in range(round(0.1 / dt)):
            solver.step(state, after, None, None, dt)
            state, after = after, state
        ends[dt] = state.particle_qd.numpy()[:, 0]
    # air leaves exp(-2 t) of the mean speed
    expected = 1.05 * np.exp(-0.2)
    for dt, speeds in ends.items():
        assert speeds.mean() == pytest.approx(expected, rel=5e-3), dt
        assert np.ptp(speeds) < 0.02


def test_a_held_particle_ends_on_its_target_whatever_the_time():
    solver, handle = cloth_solver(SMALL, height=0.05)
    for dt in (1 / 60, 1 / 60 / 32, 1 / 90):
        state, after = solver.model.state(), solver.model.state()
        control = solver.model.control()
        control.warp_deform.grip_particle.assign(np.zeros(1, np.int32))
        goal = state.particle_q.numpy()[0] + [0, 0, 0.002]
        control.warp_deform.grip_target.assign(goal[None].astype(np.float32))
        solver.step(state, after, control, None, dt)
        np.testing.assert_allclose(after.particle_q.numpy()[0], goal, atol=1e-6)
    # what hangs from it is tied to it, as in a rollout
    tethers = solver.data.lane("particles.tether", 0)
    assert tethers[0] == 0 and 0.1 < tethers[handle.count - 1] < 1.0


@pytest.mark.parametrize(
    ("particle", "target"), [(10_000, (0, 0, 0.1)), (0, (0, np.nan, 0.1)), (0, (0, 0, np.inf))]
)
def test_a_grip_on_nothing_or_to_nowhere_is_refused(particle, target):
    solver = falling()
    state, control = solver.model.state(), solver.model.control()
    control.warp_deform.grip_particle.assign(np.full(4, particle, np.int32))
    control.warp_deform.grip_target.assign(np.tile(np.float32(target), (4, 1)))
    with pytest.raises(InputError, match="grip in world 0"):
        solver.step(state, solver.model.state(), control, None, 1 / 60)


@pytest.mark.parametrize("dt", [1 / 60, 1 / 60 / 32, 1 / 1000])
def test_a_fall_that_the_speed_clamp_holds_up_is_an_error(dt):
    """Step by step as in one launch: 0.1 s with the clamp at work is too much."""
    solver = falling(SolverConfig(damping=0.0))
    state, after = solver.model.state(), solver.model.state()
    high = state.particle_q.numpy() + np.float32([0, 0, 2.0])
    state.particle_q.assign(high)
    taken = 0
    with pytest.raises(PhysicsError) as caught:
        while taken * dt < 1.0:
            solver.step(state, after, None, None, dt)
            state, after, taken = after, state, taken + 1
    assert {p.kind for p in caught.value.problems} == {ProblemKind.SPEED_CLAMP}
    assert taken * dt == pytest.approx(3.0 / G + 0.1, abs=0.03)


@pytest.mark.parametrize("name", ["max_seconds", "min_seconds", "calm", "calm_after", "record"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, "1"], ids=repr)
def test_durations_of_a_rollout_are_checked(name, value):
    with pytest.raises(InputError, match=name):
        rollout(falling(), [0], **{name: value})


@pytest.mark.parametrize(
    "push",
    [
        Push(5, np.zeros(3), 0.1),
        Push(-1, np.zeros(3), 0.1),
        Push(0, np.zeros(2), 0.1),
        Push(0, np.full(3, np.nan), 0.1),
        Push(0, np.ones(3), 1e-4),
        Push(0, np.ones(3), -1.0),
    ],
    ids=repr,
)
def test_a_push_that_would_do_nothing_or_harm_is_refused(push):
    with pytest.raises(InputError, match="Push"):
        rollout(falling(), [0], pushes={0: [push]}, max_seconds=0.1)


def test_a_bundle_of_a_fabric_reproduces_the_very_bits(tmp_path):
    """It needs viscosity and sleep as well."""
    solver, _ = cloth_solver(SMALL, height=0.02, config=CLOTH_SOLVER, bundles=tmp_path)
    solver.data.lane("particles.x", 0)[3, 0] += 0.1
    with pytest.raises(PhysicsError) as caught:
        solver.check(solver.run(30))
    after = replay_bundle(caught.value.bundle)
    for name in ("particles.x", "particles.v"):
        assert after[name].tobytes() == solver.data.views[name].tobytes(), name
