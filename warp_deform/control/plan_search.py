"""Search for plans: one interface, several methods, a budget in CPU seconds or in evaluations.

A `PlanProblem` has G goals, for each of which a plan is searched, and evaluates many plans at once:
in the lanes of one simulator that is what costs least. Methods see free numbers, K x 3 a plan (see
`smooth_plans`), and losses. Those of `plan_descent` also see gradients; those here need none.

Sources: cross-entropy method: Rubinstein, "The Cross-Entropy Method for Combinatorial and
Continuous Optimization", 1999. CMA-ES: Hansen and Ostermeier, "Completely Derandomized
Self-Adaptation in Evolution Strategies", 2001, by the package `cmaes`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..errors import InputError, WarpDeformError
from ..support.checked import COUNT, POSITIVE, check_number
from ..support.extras import install_extra
from .plan_descent import adam, lbfgs
from .plan_problem import OptimizedPlans, PlanProblem, Rounds, Search

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_ELITE = 0.2
"""Share of the draws from which the cross-entropy method draws next."""
_KEEP = 0.2
"""Share of the mean and the spread before that it keeps."""
_SPREAD = 1.5
"""Standard deviation of the free numbers at first: as of the swings that make goals."""
_LEAST_SPREAD = 0.02
_SEARCHES = 0.4
"""Share of the budget that "cem+adam" searches before it descends."""


def _cem(search: Search, rng: np.random.Generator, population: int, *, share: float = 1.0) -> None:
    """Draw around the mean of the best draws, with their spread, a goal by itself."""
    goals, shape = search.problem.goals, search.problem.shape
    mean, spread = np.zeros((goals, *shape)), np.full((goals, *shape), _SPREAD)
    elite = max(2, round(_ELITE * population))
    rounds = Rounds(search, share)
    while rounds.goes_on():
        noise = rng.normal(size=(goals, population, *shape))
        draws = mean[:, None] + spread[:, None] * noise
        if search.history:
            draws[:, 0] = search.numbers  # the best so far stays among them
        losses = search.evaluate(draws)
        best = np.argsort(losses, axis=1, kind="stable")[:, :elite]
        chosen = np.take_along_axis(draws, best[:, :, None, None], axis=1)
        mean = _KEEP * mean + (1 - _KEEP) * chosen.mean(axis=1)
        found = _KEEP * spread + (1 - _KEEP) * chosen.std(axis=1)
        spread = np.maximum(found, _LEAST_SPREAD)


def _cmaes(search: Search, rng: np.random.Generator, population: int) -> None:
    """One covariance matrix adaptation a goal, side by side."""
    try:
        from cmaes import CMA
    except ImportError as error:
        said = f"the method cmaes needs the package cmaes: {install_extra('search')}"
        raise WarpDeformError(said) from error
    goals, shape = search.problem.goals, search.problem.shape
    size = int(np.prod(shape))
    seeds = rng.integers(2**31, size=goals)
    each = [
        CMA(mean=np.zeros(size), sigma=_SPREAD, population_size=population, seed=int(seed))
        for seed in seeds
    ]
    rounds = Rounds(search)
    while rounds.goes_on():
        draws = np.array([[one.ask() for _ in range(population)] for one in each])
        losses = search.evaluate(draws.reshape(goals, population, *shape))
        # it sorts by loss, so what a guard has ended only has to be worst
        told = np.where(np.isfinite(losses), losses, 1e6)
        for one, points, values in zip(each, draws, told, strict=True):
            one.tell(list(zip(points, values.tolist(), strict=True)))


def _random(search: Search, rng: np.random.Generator, population: int) -> None:
    """The best of independent draws: what a method has to beat."""
    shape = (search.problem.goals, population, *search.problem.shape)
    rounds = Rounds(search)
    while rounds.goes_on():
        search.evaluate(rng.normal(0.0, _SPREAD, shape))


def _drawn_once(search: Search, rng: np.random.Generator, population: int) -> None:
    """Two rounds of draws at once: from the best of them a method descends."""
    shape = (search.problem.goals, 2 * population, *search.problem.shape)
    search.evaluate(rng.normal(0.0, _SPREAD, shape))


def _adam(search: Search, rng: np.random.Generator, population: int) -> None:
    """Adam from the best draws."""
    search.check_gradients("adam")
    _drawn_once(search, rng, population)
    adam(search)


def _lbfgs(search: Search, rng: np.random.Generator, population: int) -> None:
    """L-BFGS from the best draw."""
    search.check_gradients("lbfgs")
    _drawn_once(search, rng, population)
    lbfgs(search)


def _cem_adam(search: Search, rng: np.random.Generator, population: int) -> None:
    """A search with part of the budget, then Adam from the best that it has found."""
    search.check_gradients("cem+adam")
    _cem(search, rng, population, share=_SEARCHES)
    adam(search)


METHODS: dict[str, Callable[[Search, np.random.Generator, int], None]] = {
    "cem": _cem,
    "cmaes": _cmaes,
    "random": _random,
    "adam": _adam,
    "lbfgs": _lbfgs,
    "cem+adam": _cem_adam,
}
"""The methods by name."""


def optimize(
    problem: PlanProblem,
    method: str = "cem+adam",
    *,
    seconds: float | None = None,
    evaluations: int | None = None,
    population: int = 25,
    seed: int = 0,
) -> OptimizedPlans:
    """Search a plan for every goal of a problem.

        problem = SwingProblem("whip", seeds=range(32))
            found = optimize(problem, seconds=6.0)

    A budget in evaluations gives the same plans whenever it is run; one in seconds does not, as it
    depends on the machine. One round is made in any case.

    Args:
        method: "cem", "cmaes", "random"; with gradients "adam", "lbfgs", and "cem+adam", which
            searches with 40 % of the budget and descends with the rest
        seconds: of the process's CPU time, for all goals together
        evaluations: plans for each goal at most, in the mean; one with its gradient counts 2.5
        population: plans a round for each goal
        seed: of the draws

    Raises:
        InputError: there is no such method, not exactly one budget, or no gradients for a
            method that needs them.
        WarpDeformError: the method's package is not installed.
    """
    if method not in METHODS:
        raise InputError(f"method is one of {', '.join(METHODS)}, not {method!r}")
    if (seconds is None) == (evaluations is None):
        raise InputError("give one budget, either seconds or evaluations")
    if seconds is not None:
        check_number(seconds, "seconds", POSITIVE)
    else:
        check_number(evaluations, "evaluations", COUNT)
    if check_number(population, "population", COUNT) < 4:
        raise InputError(f"population is {population}; a round needs 4 plans or more")
    search = Search(problem, seconds, evaluations)
    METHODS[method](search, np.random.default_rng(seed), population)
    return OptimizedPlans(
        numbers=search.numbers,
        losses=search.losses,
        evaluations=search.evaluations,
        gradients=search.gradients,
        unusable=search.unusable,
        cpu_seconds=search.spent,
        history=np.array(search.history),
    )
