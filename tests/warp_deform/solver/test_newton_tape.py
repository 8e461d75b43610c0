"""Derivatives through `SolverFusedXPBD.step` on a `wp.Tape`, and no silent zeros beside them."""

from __future__ import annotations

from itertools import pairwise

import newton
import numpy as np
import pytest
import warp as wp
from fixtures.solver_scenes import new_builder

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.objects import BoxConfig, CableConfig, add_box, add_cable, cable_line
from warp_deform.rollout import DifferentiableRollout, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.solver.stepping import substeps

SHORT = CableConfig(beads=6)
FRAME = 1 / 60
NAMES = ("particle_q", "particle_qd", "body_q", "body_qd")
RNG = np.random.default_rng(0)


@wp.kernel(enable_backward=True)
def weigh3(a: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)):
    i = wp.tid()
    wp.atomic_add(out, 0, wp.dot(a[i], w[i]))


@wp.kernel(enable_backward=True)
def weigh_pose(
    a: wp.array(dtype=wp.transform), w: wp.array(dtype=float), out: wp.array(dtype=float)
):
    i = wp.tid()
    for k in range(7):
        wp.atomic_add(out, 0, a[i][k] * w[7 * i + k])


def scene(worlds: int = 1, **options) -> SolverFusedXPBD:
    """A cable over the table, half of it touching, and a box in the air that turns."""
    one, builder = new_builder(), new_builder()
    line = cable_line(SHORT, (0.4, 0), (0.6, 0))
    line[3:, 2] += 0.004 * np.arange(3)
    add_cable(one, SHORT, line)
    add_box(one, BoxConfig(), (0.45, 0.2, 0.2), yaw=0.3)
    builder.replicate(one, worlds)
    model = builder.finalize(device="cpu", requires_grad=True)
    solver = SolverFusedXPBD(model, SolverConfig(damping=5.0), **options)
    return solver


def start(solver: SolverFusedXPBD) -> newton.State:
    state = solver.model.state(requires_grad=True)
    rng = np.random.default_rng(1)
    state.particle_qd.assign(rng.normal(0, 0.1, (len(state.particle_q), 3)).astype(np.float32))
    state.body_qd.assign(rng.normal(0, 0.5, (len(state.body_q), 6)).astype(np.float32))
    return state


def taped(solver, state, steps=3, dt=FRAME, control=None, weights=None):
    """Loss, weights . (positions, poses) after some steps; its tape and the states."""
    states = [state, *(solver.model.state(requires_grad=True) for _ in range(steps))]
    rng = np.random.default_rng(2)
    w3 = wp.array(rng.normal(size=(len(state.particle_q), 3)).astype(np.float32), dtype=wp.vec3)
    w7 = wp.array(rng.normal(size=7 * len(state.body_q)).astype(np.float32), dtype=float)
    value = wp.zeros(1, dtype=float, requires_grad=True)
    with wp.Tape() as tape:
        for before, after in pairwise(states):
            solver.step(before, after, control, None, dt)
        for array in (states[-1].particle_q, states[-1].particle_qd):
            wp.launch(weigh3, dim=len(array), inputs=[array, w3, value])
        wp.launch(weigh_pose, dim=len(state.body_q), inputs=[states[-1].body_q, w7, value])
    return value, tape, states, (w3.numpy(), w7.numpy().reshape(-1, 7))


def gradients(state: newton.State) -> dict[str, np.ndarray]:
    return {name: getattr(state, name).grad.numpy().copy() for name in NAMES}


@pytest.mark.parametrize("dt", [FRAME, FRAME / 32, 0.0101])
@pytest.mark.parametrize(
    ("worlds", "options"), [(1, {"lanes": 1, "precision": "float64"}), (3, {"lanes": 1})]
)
def test_the_tape_gives_the_derivatives_of_one_rollout(dt, worlds, options):
    solver = scene(worlds, **options)
    state = start(solver)
    value, tape, _, (w3, w7) = taped(solver, state, dt=dt)
    tape.backward(value)
    found = gradients(state)
    # the same in one go, to within the rounding of the states between
    solver.read_state(state)
    count, substep = substeps(dt, solver.config.dt)
    run = DifferentiableRollout(solver, dt=substep)
    run.forward(range(worlds), [3 * count * substep])
    each = w3.reshape(worlds, 1, -1, 3)
    by = run.backward(each, each, bodies=w7.reshape(worlds, 1, -1, 7))
    for name, of in zip(
        NAMES, (by.positions, by.velocities, by.body_poses, by.body_velocities), strict=True
    ):
        expected = of.reshape(found[name].shape)
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(
            found[name], expected, rtol=0, atol=5e-3 * np.abs(expected).max(), err_msg=name
        )


def test_the_derivatives_are_those_of_differences():
    solver = scene(precision="float64")
    state = start(solver)
    # in the air, where no contact comes or goes within a difference
    state.particle_q.assign(state.particle_q.numpy() + np.float32([0, 0, 0.1]))
    value, tape, _, _ = taped(solver, state)
    tape.backward(value)
    found = gradients(state)
    for name in ("particle_q", "particle_qd", "body_qd"):
        given = getattr(state, name)
        base = given.numpy().copy()
        way = np.random.default_rng(3).normal(size=base.shape)
        ends, step = [], 1e-3 if name != "particle_q" else 1e-4
        for sign in (1, -1):
            given.assign((base + sign * step * way).astype(np.float32))
            ends.append(float(taped(solver, state)[0].numpy()[0]))
        given.assign(base)
        slope = (ends[0] - ends[1]) / (2 * step)
        assert (found[name] * way).sum() == pytest.approx(slope, rel=0.02, abs=0.02), name


def test_gradients_add_up_and_a_zeroed_tape_is_used_again():
    solver = scene()
    state = start(solver)
    value, tape, _, _ = taped(solver, state)
    tape.backward(value)
    first = gradients(state)
    tape.zero()
    assert not any(slope.any() for slope in gradients(state).values())
    tape.backward(value)
    for name, again in gradients(state).items():
        np.testing.assert_array_equal(again, first[name])


def test_the_solver_may_be_used_between_tape_and_backward():
    solver = scene()
    state = start(solver)
    value, tape, _, _ = taped(solver, state)
    tape.backward(value)
    first = gradients(state)
    tape.zero()
    rollout(solver, [0], max_seconds=0.2)
    solver.set_world(0, damping=0.0)
    tape.backward(value)
    np.testing.assert_array_equal(gradients(state)["particle_q"], first["particle_q"])


def test_steps_on_a_tape_have_the_bits_of_steps_without():
    solver, other = scene(2, lanes=1), scene(2, lanes=1)
    _, _, states, _ = taped(solver, start(solver))
    before, after = start(other), other.model.state()
    for _ in range(3):
        other.step(before, after, None, None, FRAME)
        before, after = after, before
    for name in NAMES:
        assert (
            getattr(states[-1], name).numpy().tobytes() == getattr(before, name).numpy().tobytes()
        )


def test_the_target_of_a_grip_has_derivatives():
    solver = scene(precision="float64")
    control = solver.model.control()
    ours = control.warp_deform
    ours.grip_particle.assign(np.zeros(1, np.int32))
    ours.grip_target = wp.array([(0.4, 0.01, 0.03)], dtype=wp.vec3, requires_grad=True)
    value, tape, _, _ = taped(solver, start(solver), steps=1, control=control)
    tape.backward(value)
    found = ours.grip_target.grad.numpy()[0].copy()
    base, slopes = ours.grip_target.numpy().copy(), []
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            moved = base.copy()
            moved[0, axis] += sign * 1e-4
            ours.grip_target.assign(moved)
            ends.append(float(taped(solver, start(solver), steps=1, control=control)[0].numpy()[0]))
        slopes.append((ends[0] - ends[1]) / 2e-4)
    np.testing.assert_allclose(found, slopes, rtol=0.03, atol=0.03 * np.abs(slopes).max())


def test_what_would_lose_derivatives_is_refused_by_name():
    solver = scene()
    state, after = start(solver), solver.model.state(requires_grad=True)
    deaf = solver.model.state(requires_grad=False)
    for array in vars(deaf).values():
        if isinstance(array, wp.array):
            array.requires_grad = False
    with wp.Tape():
        with pytest.raises(InputError, match=r"state_out\.particle_q needs requires_grad"):
            solver.step(state, deaf, None, None, FRAME)
        with pytest.raises(InputError, match="a state of its own"):
            solver.step(state, state, None, None, FRAME)
        solver.step(state, after, None, None, FRAME)
        with pytest.raises(InputError, match="a state of its own"):
            solver.step(after, state, None, None, FRAME)
        rollout(solver, [0], max_seconds=0.01)
        with pytest.raises(InputError, match="write_state leaves no derivatives"):
            solver.write_state(after)


def test_a_constant_start_leaves_nothing_on_the_tape():
    solver = scene()
    state, after = start(solver), solver.model.state(requires_grad=True)
    for name in NAMES:
        getattr(state, name).requires_grad = False
    with wp.Tape() as tape:
        solver.step(state, after, None, None, FRAME)
    assert not tape.launches


@pytest.mark.parametrize("kept", ["_src", "tape"])
def test_a_warp_that_keeps_its_tape_elsewhere_is_refused_by_name(kept, monkeypatch):
    """Nobody could tell whether derivatives are asked for, so nothing is stepped."""
    solver = scene()
    state, after = start(solver), solver.model.state(requires_grad=True)
    if kept == "_src":
        monkeypatch.delattr(wp, "_src")
    else:
        monkeypatch.setattr(wp._src.context, "runtime", object())
    monkeypatch.setattr(wp, "init", lambda: None)
    with pytest.raises(WarpDeformError, match="does not say which tape records"):
        solver.step(state, after, None, None, FRAME)
