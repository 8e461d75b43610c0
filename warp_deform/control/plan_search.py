"""Search for plans: one interface, several methods, a budget in CPU seconds or in evaluations.

A `PlanProblem` has G goals, for each of which a plan is searched, and evaluates many plans at once:
in the lanes of one simulator that is what costs least. Methods see free numbers, K x 3 a plan (see
`smooth_plans`), and losses; none needs a derivative.

Sources: cross-entropy method: Rubinstein, "The Cross-Entropy Method for Combinatorial and
Continuous Optimization", 1999. CMA-ES: Hansen and Ostermeier, "Completely Derandomized
Self-Adaptation in Evolution Strategies", 2001, by the package `cmaes`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..errors import InputError, WarpDeformError
from ..support.checked import COUNT, POSITIVE, check_number
from ..support.extras import install_extra

__all__ = ["OptimizedPlans", "PlanProblem"]  # `warp_deform.control` has `optimize` and `METHODS`

_ELITE = 0.2
"""Share of the draws from which the cross-entropy method draws next."""
_KEEP = 0.2
"""Share of the mean and the spread before that it keeps."""
_SPREAD = 1.5
"""Standard deviation of the free numbers at first: as of the swings that make goals."""
_LEAST_SPREAD = 0.02


class PlanProblem(Protocol):
    """Goals, and what plans for them come to."""

    @property
    def goals(self) -> int:
        """Number of goals G."""

    @property
    def shape(self) -> tuple[int, int]:
        """Of the free numbers of a plan (K, 3)."""

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        """Losses (G, N) of plans with these free numbers (G, N, K, 3); inf where a guard fires."""


@dataclass(frozen=True, eq=False)
class OptimizedPlans:
    """What a search found.

    Attributes:
        numbers: free numbers of the best plans (G, K, 3)
        losses: of these (G,); inf where every plan made a guard fire
        evaluations: plans that were evaluated for each goal
        cpu_seconds: process time that the search took
        history: best losses so far (R, G) after every round
    """

    numbers: np.ndarray
    losses: np.ndarray
    evaluations: int
    cpu_seconds: float
    history: np.ndarray


class _Search:
    """Evaluates within the budget and keeps the best."""

    def __init__(self, problem: PlanProblem, seconds: float | None, evaluations: int | None):
        self.problem, self.seconds, self.most = problem, seconds, evaluations
        self.numbers = np.zeros((problem.goals, *problem.shape))
        self.losses = np.full(problem.goals, np.inf)
        self.evaluations, self.history = 0, list[np.ndarray]()
        self._begun = time.process_time()

    @property
    def spent(self) -> float:
        return time.process_time() - self._begun

    def goes_on(self) -> bool:
        """Whether another round fits the budget; there is one at least."""
        if not self.history:
            return True
        if self.most is not None:
            return self.evaluations + self.evaluations // len(self.history) <= self.most
        assert self.seconds is not None
        return self.spent * (1 + 1 / len(self.history)) <= self.seconds

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        losses = np.asarray(self.problem.evaluate(numbers))
        losses = np.where(np.isfinite(losses), losses, np.inf)
        best = losses.argmin(axis=1)
        rows = np.arange(len(best))
        better = losses[rows, best] < self.losses
        self.losses[better] = losses[rows, best][better]
        self.numbers[better] = numbers[rows, best][better]
        self.evaluations += numbers.shape[1]
        self.history.append(self.losses.copy())
        return losses


def _cem(search: _Search, rng: np.random.Generator, population: int) -> None:
    """Draw around the mean of the best draws, with their spread, a goal by itself."""
    goals, shape = search.problem.goals, search.problem.shape
    mean, spread = np.zeros((goals, *shape)), np.full((goals, *shape), _SPREAD)
    elite = max(2, round(_ELITE * population))
    while search.goes_on():
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


def _cmaes(search: _Search, rng: np.random.Generator, population: int) -> None:
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
    while search.goes_on():
        draws = np.array([[one.ask() for _ in range(population)] for one in each])
        losses = search.evaluate(draws.reshape(goals, population, *shape))
        # it sorts by loss, so what a guard has ended only has to be worst
        told = np.where(np.isfinite(losses), losses, 1e6)
        for one, points, values in zip(each, draws, told, strict=True):
            one.tell(list(zip(points, values.tolist(), strict=True)))


def _random(search: _Search, rng: np.random.Generator, population: int) -> None:
    """The best of independent draws: what a method has to beat."""
    shape = (search.problem.goals, population, *search.problem.shape)
    while search.goes_on():
        search.evaluate(rng.normal(0.0, _SPREAD, shape))


METHODS: dict[str, Callable[[_Search, np.random.Generator, int], None]] = {
    "cem": _cem,
    "cmaes": _cmaes,
    "random": _random,
}
"""The methods by name."""


def optimize(
    problem: PlanProblem,
    method: str = "cem",
    *,
    seconds: float | None = None,
    evaluations: int | None = None,
    population: int = 25,
    seed: int = 0,
) -> OptimizedPlans:
    """Search a plan for every goal of a problem.

        problem = SwingProblem("whip", seeds=range(32))
        found = optimize(problem, "cem", evaluations=250)

    A budget in evaluations gives the same plans whenever it is run; one in seconds does not, as it
    depends on the machine. One round is made in any case.

    Args:
        method: "cem", "cmaes" or "random"
        seconds: of the process's CPU time, for all goals together
        evaluations: plans for each goal at most
        population: plans a round for each goal
        seed: of the draws

    Raises:
        InputError: there is no such method, or not exactly one budget.
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
    search = _Search(problem, seconds, evaluations)
    METHODS[method](search, np.random.default_rng(seed), population)
    return OptimizedPlans(
        search.numbers, search.losses, search.evaluations, search.spent, np.array(search.history)
    )
