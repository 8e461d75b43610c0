"""The rest of a swing, planned again at every step: from where it is, better, and never worse."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from warp_deform.control import Replanner, SwingProblem, TensorControlWorlds, optimize
from warp_deform.control.limits import TipLimits
from warp_deform.errors import InputError
from warp_deform.robots import robot

SEEDS = range(30_000, 30_008)


@pytest.fixture(scope="module")
def problem() -> SwingProblem:
    return SwingProblem("whip-target", SEEDS, worlds=8)


@pytest.fixture(scope="module")
def plans(problem: SwingProblem) -> np.ndarray:
    return optimize(problem, "adam", evaluations=150).numbers


@pytest.fixture(scope="module")
def worlds() -> TensorControlWorlds:
    return TensorControlWorlds("whip-target", len(SEEDS), start="held", action_penalty=0.0)


def play(
    worlds: TensorControlWorlds,
    act: Replanner,
    *,
    noise: float = 0.0,
    damping: float = 1.0,
    steps: int | None = None,
) -> np.ndarray:
    """Observations of every step (T + 1, G, D); worlds stay where the last one was seen."""
    worlds.reset(dict(enumerate(SEEDS)))
    solver, rng = worlds.worlds.solver, np.random.default_rng(0)
    for world in range(len(SEEDS)):
        solver.set_world(world, damping=damping * solver.config.damping)
    seen = [worlds.observe().numpy()]
    while worlds.running.any() and (steps is None or len(seen) <= steps):
        actions = act(seen[-1])
        actions[:, :3] += noise * rng.normal(size=(len(actions), 3))
        with torch.no_grad():
            worlds.advance(torch.from_numpy(actions))
        seen.append(worlds.observe().numpy())
    return np.stack(seen)


def test_without_rounds_it_plays_the_plan_to_its_bits(problem, plans, worlds) -> None:
    act = Replanner(problem, plans, rounds=0)
    seen = play(worlds, act)
    actions = problem.actions(plans)
    worlds.reset(dict(enumerate(SEEDS)))
    again = [worlds.observe().numpy()]
    for rows in actions.swapaxes(0, 1):
        worlds.advance(torch.from_numpy(rows))
        again.append(worlds.observe().numpy())
    np.testing.assert_array_equal(seen, np.stack(again))
    ends = problem.evaluate(plans[:, None])[:, 0]
    np.testing.assert_allclose(worlds.left.numpy(), ends, atol=1e-6)


@pytest.mark.parametrize("step", [1, 7, 19])
def test_a_plan_that_begins_amid_an_episode_ends_as_the_whole(
    problem, plans, worlds, step: int
) -> None:
    before = problem.evaluate(plans[:, None])[:, 0]
    play(worlds, Replanner(problem, plans, rounds=0), steps=step)
    state, limits = worlds._tensors.state, worlds.targets
    rest = problem.refined(plans)[:, step:]
    tips = limits.sent(range(len(SEEDS)))
    with problem.begun_at(state.positions.numpy(), state.velocities.numpy(), tips, steps=20 - step):
        assert problem.actions(rest).shape == (len(SEEDS), 20 - step, 4)
        ends = problem.evaluate(rest[:, None])[:, 0]
        losses, gradients = problem.gradients(rest, np.arange(len(SEEDS)))
    np.testing.assert_allclose(ends, before, atol=2e-3)
    np.testing.assert_array_equal(losses, ends)
    assert gradients.shape == rest.shape and np.abs(gradients[:, 0]).min() > 0
    np.testing.assert_array_equal(problem.evaluate(plans[:, None])[:, 0], before)


def test_what_nothing_disturbs_gets_better_and_what_is_disturbed_much(
    problem, plans, worlds
) -> None:
    def left(rounds: int, **disturbed: float) -> np.ndarray:
        play(worlds, Replanner(problem, plans, rounds=rounds), **disturbed)
        assert worlds.trusted.all()
        return worlds.left.numpy()

    planned, again = left(0), left(4)
    assert again.mean() < planned.mean() and (again < planned + 2e-3).all()
    for disturbed in ({"noise": 0.1}, {"damping": 1.5}):
        assert left(6, **disturbed).mean() < 0.6 * left(0, **disturbed).mean()


def test_it_plays_the_same_twice(problem, plans, worlds) -> None:
    act = Replanner(problem, plans, rounds=2)
    first = play(worlds, act, noise=0.05)
    with pytest.raises(InputError, match="an episode has 20 steps"):
        act(first[-1])
    np.testing.assert_array_equal(first, play(worlds, act, noise=0.05))


def test_where_gradients_are_off_it_has_its_own(problem, plans) -> None:
    numbers, goals = problem.refined(plans), np.arange(len(SEEDS))
    with torch.no_grad():
        _, off = problem.gradients(numbers, goals)
    np.testing.assert_array_equal(off, problem.gradients(numbers, goals)[1])


def test_what_does_not_fit_is_refused(problem, plans, worlds) -> None:
    for numbers in (plans[:3], plans[:, :, :2], plans[0]):
        with pytest.raises(InputError, match=r"numbers must have the shape \(8, K, 3\)"):
            Replanner(problem, numbers)
    with pytest.raises(InputError, match="finite"):
        Replanner(problem, np.where(plans > 0, plans, np.nan))
    for rounds in (-1, 1.5, True):
        with pytest.raises(InputError, match="rounds is a number of gradients"):
            Replanner(problem, plans, rounds=rounds)
    act = Replanner(problem, plans)
    worlds.reset(dict(enumerate(SEEDS)))
    first = worlds.observe().numpy()
    for other in (first[:5], first[0], first[:, :60]):
        with pytest.raises(InputError, match='what "state" shows of 8 episodes'):
            act(other)
    act(first)
    gone = first.copy()
    gone[:, -1] = 1 / 20
    gone[2, -1] = 0.0  # a guard has ended it, so it stays where it is
    act(gone)
    gone[:, -1] = np.where(gone[:, -1] > 0, 2 / 20, 0.0)
    gone[2] = 0.0
    assert np.isfinite(act(gone)).all()
    gone[3, -1] = 0.0
    with pytest.raises(InputError, match=r"step 3 of every episode follows, not steps \[0\]"):
        act(gone)
    act(first)
    late = first.copy()
    late[:, -1] = 5 / 20
    with pytest.raises(InputError, match=r"step 1 of every episode follows, not steps \[5\]"):
        act(late)
    act(first)  # an episode may begin anew at any time
    zeros = np.zeros((8, problem.particles, 3))
    for given, steps in (((zeros, zeros, np.zeros((8, 3))), 5), ((zeros[:4], zeros, first), 5)):
        with (
            pytest.raises(InputError, match="must have the shape"),
            problem.begun_at(*given, steps=steps),
        ):
            pass
    for steps in (0, 21):
        with (
            pytest.raises(InputError, match="steps must be 1 to 20"),
            problem.begun_at(zeros, zeros, np.zeros((8, 4)), steps=steps),
        ):
            pass


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_the_target_of_a_tip_is_found_again(name: str) -> None:
    limits = TipLimits(robot(name))
    rng = np.random.default_rng(0)
    asked = rng.uniform([-0.1, -0.9, -0.05, -3], [1.1, 0.9, 0.9, 3], (4000, 4))
    floors = rng.uniform(0.0, 0.03, 4000)
    asked = limits.kept(asked, floors)
    tips = limits.project(asked, floors)
    found = limits.asked(tips, floors)
    np.testing.assert_allclose(limits.project(found, floors), tips, atol=2e-5)
    inside = (np.abs(tips - asked)[:, :3] < 1e-4).all(axis=1)
    assert inside.sum() > 500
    np.testing.assert_allclose(found[inside], asked[inside], atol=1e-4)
