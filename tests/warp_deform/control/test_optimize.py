"""Search for plans: on a problem in closed form, and on swings, with the environment's bits."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from warp_deform.control import METHODS, ControlWorlds, SwingProblem, optimize
from warp_deform.control.smooth_plans import KNOTS, actions_of
from warp_deform.errors import InputError, WarpDeformError


class Bowls:
    """The least of each goal's bowl is known; beyond a wall there is none."""

    goals, shape = 3, (KNOTS, 3)

    def __init__(self) -> None:
        self.lowest = np.random.default_rng(5).normal(0.0, 0.7, (3, KNOTS, 3))
        self.sizes: list[int] = []

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        self.sizes.append(numbers.shape[1])
        losses = ((numbers - self.lowest[:, None]) ** 2).sum(axis=(2, 3))
        return np.where(numbers[:, :, 0, 0] > 3.0, np.inf, losses)


@pytest.mark.parametrize("method", METHODS)
def test_a_method_keeps_to_its_budget_and_goes_the_same_way_twice(method: str) -> None:
    first, problem = (optimize(Bowls(), method, evaluations=260, seed=3), Bowls())
    again = optimize(problem, method, evaluations=260, seed=3)
    assert np.array_equal(first.numbers, again.numbers) and again.evaluations == 250
    assert sum(problem.sizes) == 250 and len(again.history) == 10
    assert (np.diff(again.history, axis=0) <= 0).all()
    assert np.array_equal(again.history[-1], again.losses)
    rows = problem.evaluate(again.numbers[:, None])[:, 0]
    assert rows == pytest.approx(again.losses), "what is told is what the plans come to"
    other = optimize(Bowls(), method, evaluations=260, seed=4)
    assert not np.array_equal(other.numbers, again.numbers)


def test_methods_find_a_bowls_lowest_point_where_draws_alone_do_not() -> None:
    ends = {method: optimize(Bowls(), method, evaluations=3000).losses.max() for method in METHODS}
    assert ends["cem"] < 0.05 and ends["cmaes"] < 0.05 < 1 < ends["random"]


def test_a_budget_in_seconds_ends_a_search_and_one_round_is_always_made() -> None:
    short = optimize(Bowls(), "cem", seconds=1e-9)
    assert short.evaluations == 25 and np.isfinite(short.losses).all()
    longer = optimize(Bowls(), "cem", seconds=0.3)
    assert longer.evaluations > 100 and longer.cpu_seconds < 0.6


def test_where_every_plan_fails_none_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    walls = Bowls()
    walls.evaluate = lambda numbers: np.full(numbers.shape[:2], np.nan)  # type: ignore[method-assign]
    for method in METHODS:
        assert np.isinf(optimize(walls, method, evaluations=50).losses).all()


@pytest.mark.parametrize("task", ["whip", "whip-target"])
def test_a_plan_has_the_loss_of_the_environment_to_the_bit(task: str) -> None:
    problem = SwingProblem(task, [4, 9], worlds=8)
    numbers = np.random.default_rng(0).normal(0.0, 1.5, (2, 6, KNOTS, 3))
    losses = problem.evaluate(numbers)  # 12 plans: 8 worlds and a rest
    goals, ends = problem.run(numbers)
    assert losses.shape == (2, 6) and goals.tolist() == [0] * 6 + [1] * 6
    env = ControlWorlds(task, 1, action_penalty=0.0)
    env.reset({0: 9})
    for action in problem.actions(numbers[1, 5]):
        done = env.step({0: action})[0]
    assert done.truncated
    assert np.array_equal(env.worlds.solver.particle_q(0).astype(float), ends[11])
    episode = env.worlds.episodes[0]
    assert np.array_equal(episode.layout.targets, problem.layouts[1].targets)
    left = env.rewards._remaining([0])[0]
    assert left == pytest.approx(losses[1, 5], rel=1e-12)


def test_search_swings_nearer_than_draws_do() -> None:
    problem = SwingProblem("whip-target", range(4), worlds=32)
    drawn = optimize(problem, "random", evaluations=150)
    found = optimize(problem, "cem", evaluations=150)
    assert found.losses.mean() < 0.7 * drawn.losses.mean()


def test_plans_are_never_longer_than_a_tip_goes() -> None:
    actions = actions_of(np.random.default_rng(0).normal(0, 50, (100, KNOTS, 3)), 20)
    assert (np.linalg.norm(actions, axis=-1) < 1).all() and actions.shape == (100, 20, 3)


def test_what_cannot_be_searched_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for options, said in (
        ({"method": "adam", "evaluations": 9}, "method is one of cem, cmaes"),
        ({}, "one budget"),
        ({"seconds": 1.0, "evaluations": 9}, "one budget"),
        ({"seconds": 0.0}, "seconds"),
        ({"evaluations": 9, "population": 3}, "population"),
    ):
        with pytest.raises(InputError, match=said):
            optimize(Bowls(), **options)
    with pytest.raises(InputError, match="no swing"):
        SwingProblem("block-notarget", [0])
    with pytest.raises(InputError, match="multiple of 8"):
        SwingProblem("whip", [0], worlds=12)
    monkeypatch.setitem(sys.modules, "cmaes", None)
    with pytest.raises(WarpDeformError, match=r"\[search\]"):
        optimize(Bowls(), "cmaes", evaluations=50)
