"""Search for plans: on a problem in closed form, and on swings, with the environment's bits."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from warp_deform.control import METHODS, ControlWorlds, SwingProblem, optimize, plan_descent
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


class SmoothBowls(Bowls):
    """The same with gradients."""

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        return numbers.copy()

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.sizes.append(-len(goals))
        away = numbers - self.lowest[goals]
        losses = (away**2).sum(axis=(1, 2))
        return np.where(numbers[:, 0, 0] > 3.0, np.inf, losses), 2 * away


class Hollows(SmoothBowls):
    """A deep hollow and a shallow one; waves across hide from draws which is which."""

    goals = 40

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        x, waves = numbers[:, :, 0, 0], numbers[:, :, 1]
        hollows = np.minimum(0.3 * (x + 1.5) ** 2 + 0.5, 0.3 * (x - 1.5) ** 2)
        return hollows + (1 - np.cos(3 * waves)).sum(axis=-1)

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, out = numbers[:, 0, 0], np.zeros_like(numbers)
        shallow = 0.3 * (x + 1.5) ** 2 + 0.5 < 0.3 * (x - 1.5) ** 2
        out[:, 0, 0] = 0.6 * np.where(shallow, x + 1.5, x - 1.5)
        out[:, 1] = 3 * np.sin(3 * numbers[:, 1])
        return self.evaluate(numbers[:, None])[:, 0], out


SEARCHES, DESCENTS = ("cem", "cmaes", "random"), ("adam", "lbfgs", "cem+adam")


def test_every_method_is_tested() -> None:
    assert tuple(METHODS) == SEARCHES + DESCENTS


@pytest.mark.parametrize("method", DESCENTS)
def test_a_descent_keeps_to_its_budget_and_goes_the_same_way_twice(method: str) -> None:
    problem = SmoothBowls()
    first = optimize(SmoothBowls(), method, evaluations=250, seed=3)
    again = optimize(problem, method, evaluations=250, seed=3)
    assert np.array_equal(first.numbers, again.numbers)
    drawn = sum(size for size in problem.sizes if size > 0)
    descended = -sum(size for size in problem.sizes if size < 0) / problem.goals
    assert again.gradients == pytest.approx(descended) and descended > 0
    assert again.evaluations == pytest.approx(drawn + descended)
    assert drawn == (100 if method == "cem+adam" else 50), "40 % of the budget, or two rounds"
    assert drawn + 2.5 * descended <= 250
    if method != "lbfgs":  # which may be done before
        assert drawn + 2.5 * descended > 240
    assert (np.diff(again.history, axis=0) <= 0).all()
    rows = problem.evaluate(again.numbers[:, None])[:, 0]
    assert rows == pytest.approx(again.losses, abs=1e-12), "what is told is what plans come to"
    searched = optimize(SmoothBowls(), "cem", evaluations=250, seed=3)
    assert (again.losses < 0.1 * searched.losses).all()
    assert again.unusable == 0


def test_lbfgs_stops_where_all_goals_are_done_and_leaves_no_thread() -> None:
    before = threading.active_count()
    found = optimize(SmoothBowls(), "lbfgs", evaluations=5000)
    assert found.evaluations < 100 and (found.losses < 1e-9).all()
    broken = SmoothBowls()
    broken.gradients = lambda numbers, goals: 1 / 0  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError):
        optimize(broken, "lbfgs", evaluations=500)
    assert threading.active_count() == before


@pytest.mark.parametrize("method", DESCENTS)
def test_derivatives_that_are_no_numbers_are_counted_and_spoil_nothing(method: str) -> None:
    class Holes(SmoothBowls):
        def gradients(
            self, numbers: np.ndarray, goals: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray]:
            losses, gradients = super().gradients(numbers, goals)
            gradients[goals == 1] = np.nan
            losses[goals == 2], gradients[goals == 2] = np.inf, np.inf
            self.spoilt += int((goals > 0).sum())
            return losses, gradients

        spoilt = 0

    problem = Holes()
    found = optimize(problem, method, evaluations=250)
    assert np.isfinite(found.losses).all() and np.isfinite(found.numbers).all()
    assert found.losses[0] < 0.05 < min(found.losses[1:]), "one goes on, the others stay"
    assert found.unusable == problem.spoilt >= 2


def test_the_worst_start_again_and_find_deeper_hollows(monkeypatch: pytest.MonkeyPatch) -> None:
    found = optimize(Hollows(), "adam", evaluations=300)
    monkeypatch.setattr(plan_descent, "_STAGES", ((1.0, 1.0),))
    once = optimize(Hollows(), "adam", evaluations=300)
    deep, before = (found.losses < 0.4).mean(), (once.losses < 0.4).mean()
    assert before < 0.9 and deep >= 0.95
    assert found.evaluations == pytest.approx(once.evaluations, rel=0.02)


@pytest.mark.parametrize("method", SEARCHES)
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
    ends = {method: optimize(Bowls(), method, evaluations=3000).losses.max() for method in SEARCHES}
    assert ends["cem"] < 0.05 and ends["cmaes"] < 0.05 < 1 < ends["random"]


def test_a_budget_in_seconds_ends_a_search_and_one_round_is_always_made() -> None:
    short = optimize(Bowls(), "cem", seconds=1e-9)
    assert short.evaluations == 25 and np.isfinite(short.losses).all()
    longer = optimize(Bowls(), "cem", seconds=0.3)
    assert longer.evaluations > 100 and longer.cpu_seconds < 0.6


def test_where_every_plan_fails_none_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    walls = Bowls()
    walls.evaluate = lambda numbers: np.full(numbers.shape[:2], np.nan)  # type: ignore[method-assign]
    for method in SEARCHES:
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


def test_derivatives_have_the_bits_of_plans_and_lead_down() -> None:
    problem = SwingProblem("whip-target", [4, 9], worlds=8)
    numbers = np.random.default_rng(1).normal([0.0, 0.0, 1.0], 0.5, (2, KNOTS, 3))  # in the air
    fine = problem.refined(numbers)
    assert fine.shape == (2, 20, 3) and np.array_equal(problem.refined(fine), fine)
    losses, gradients = problem.gradients(fine, np.arange(2))
    assert np.array_equal(losses, problem.evaluate(fine[:, None])[:, 0])
    assert np.array_equal(losses, problem.evaluate(numbers[:, None])[:, 0])
    assert gradients.shape == fine.shape and np.isfinite(gradients).all()
    some = problem.gradients(fine[1:], np.array([1]))
    assert np.array_equal(some[0], losses[1:]) and np.array_equal(some[1], gradients[1:])
    # by the last knots it is tame enough for differences
    way = np.zeros_like(fine)
    last = gradients[:, 16:]
    way[:, 16:] = last / np.linalg.norm(last, axis=(1, 2), keepdims=True)
    ends = [problem.evaluate((fine + h * way)[:, None])[:, 0] for h in (3e-3, -3e-3)]
    found, expected = (gradients * way).sum(axis=(1, 2)), (ends[0] - ends[1]) / 6e-3
    assert found == pytest.approx(expected, abs=0.02 * found.max()) and found.max() > 0.01


def test_a_descent_after_a_search_beats_the_search_alone() -> None:
    problem = SwingProblem("whip-target", range(4), worlds=32)
    searched = optimize(problem, "cem", evaluations=150)
    found = optimize(problem, evaluations=150)
    assert found.losses.mean() < 0.7 * searched.losses.mean()
    assert found.losses == pytest.approx(problem.evaluate(found.numbers[:, None])[:, 0], rel=0)
    assert problem.actions(found.numbers).shape == (4, 20, 4)


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
        ({"method": "newton", "evaluations": 9}, "method is one of cem, cmaes"),
        ({"method": "lbfgs", "evaluations": 9}, "needs a problem with gradients"),
        ({"evaluations": 9}, r"cem\+adam needs a problem with gradients"),
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
