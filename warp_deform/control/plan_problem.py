"""What is searched for plans, and the account of a search: what it spends, what it has found."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np

from ..errors import InputError

__all__ = ["DifferentiableProblem", "OptimizedPlans", "PlanProblem", "in_parts"]

GRADIENT = 2.5
"""What a plan with its gradient costs, in plans."""


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


class DifferentiableProblem(PlanProblem, Protocol):
    """A problem with gradients."""

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers (G, K', 3), as many as there is use for, of the plans that have (G, K, 3).

        A search wants few numbers, a descent many: they leave it more ways to go.
        """

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Losses (n,) of plans (n, K, 3), inf where a guard fires, and their gradients (n, K, 3).

        Args:
            goals: the numbers of n different goals that the plans are for, ascending
        """


def in_parts(
    gradients: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    goals: np.ndarray,
    numbers: np.ndarray,
    room: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Losses and gradients of plans, taken by `gradients` for at most `room` goals at a time."""
    parts = [
        gradients(goals[first : first + room], numbers[first : first + room])
        for first in range(0, len(goals), room)
    ]
    losses, found = (np.concatenate(part) for part in zip(*parts, strict=True))
    return losses, found


@dataclass(frozen=True, eq=False)
class OptimizedPlans:
    """What a search found.

    Attributes:
        numbers: free numbers of the best plans (G, K, 3); methods that descend have more of them
            than the problem's shape says, see `DifferentiableProblem.refined`
        losses: of these (G,), as `evaluate` of the problem has them; inf where every plan made a
            guard fire
        evaluations: plans that were evaluated, with gradients or without: mean over the goals
        gradients: of these, plans with gradients
        unusable: of all goals, plans whose gradients were not all finite numbers, or of a state
            that a guard has found wrong: nothing was learnt from them
        cpu_seconds: process time that the search took
        history: best losses so far (R, G) after every round
    """

    numbers: np.ndarray
    losses: np.ndarray
    evaluations: float
    gradients: float
    unusable: int
    cpu_seconds: float
    history: np.ndarray


class Search:
    """Evaluates within the budget and keeps the best.

    Args:
        seconds: of the process's CPU time; None: as many as it takes
        evaluations: for each goal at most, in the mean; one with its gradient counts `GRADIENT`.
            None: any number

    Attributes:
        first: what was drawn first: free numbers (G, N, K, 3), the best plans first
    """

    def __init__(self, problem: PlanProblem, seconds: float | None, evaluations: int | None):
        self.problem, self.seconds, self.most = problem, seconds, evaluations
        self.numbers = np.zeros((problem.goals, *problem.shape))
        self.losses = np.full(problem.goals, np.inf)
        self.first: np.ndarray | None = None
        self.evaluations = self.gradients = 0.0
        self.unusable = 0
        self.history = list[np.ndarray]()
        self._rows = np.arange(problem.goals)
        self._begun = time.process_time()

    @property
    def spent(self) -> float:
        """CPU seconds so far."""
        return time.process_time() - self._begun

    @property
    def share(self) -> float:
        """Of the budget, what is spent."""
        if self.most is not None:
            return (self.evaluations + (GRADIENT - 1) * self.gradients) / self.most
        assert self.seconds is not None, "there is one budget"
        return self.spent / self.seconds

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        """Losses (G, N) of plans (G, N, K, 3); the best are kept."""
        losses = np.asarray(self.problem.evaluate(numbers))
        self.evaluations += numbers.shape[1]
        if self.first is None:
            order = np.argsort(losses, axis=1, kind="stable")
            self.first = np.take_along_axis(numbers, order[:, :, None, None], axis=1)
        return self._noted(self._rows, numbers, losses)

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        """The plans (G, K, 3) with as many numbers (G, K', 3) as a descent wants."""
        return cast(DifferentiableProblem, self.problem).refined(numbers)

    def refine(self) -> None:
        """Go on with more numbers of the same plans."""
        self.numbers = self.refined(self.numbers)

    def descend(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Losses (n,) of plans (n, K, 3) for these goals, and gradients, 0 where of no use."""
        problem = cast(DifferentiableProblem, self.problem)
        losses, gradients = problem.gradients(numbers, goals)
        self.evaluations += len(goals) / len(self._rows)
        self.gradients += len(goals) / len(self._rows)
        losses = self._noted(goals, numbers[:, None], np.asarray(losses)[:, None])[:, 0]
        usable = np.isfinite(losses) & np.isfinite(gradients).all(axis=(1, 2))
        self.unusable += int((~usable).sum())
        return losses, np.where(usable[:, None, None], gradients, 0.0)

    def _noted(self, goals: np.ndarray, numbers: np.ndarray, losses: np.ndarray) -> np.ndarray:
        losses = np.where(np.isfinite(losses), losses, np.inf)
        rows, best = np.arange(len(goals)), losses.argmin(axis=1)
        better = losses[rows, best] < self.losses[goals]
        self.losses[goals[better]] = losses[rows, best][better]
        self.numbers[goals[better]] = numbers[rows, best][better]
        self.history.append(self.losses.copy())
        return losses

    def check_gradients(self, method: str) -> None:
        """Refuse a method that needs gradients, where the problem has none.

        Raises:
            InputError: it has none.
        """
        if not hasattr(self.problem, "gradients"):
            raise InputError(
                f"the method {method} needs a problem with gradients(numbers, goals); cem needs "
                "none"
            )


class Rounds:
    """Asks whether another round of one kind fits into a share of a search's budget.

    The first one always does where `first`, so that a search comes to something.
    """

    def __init__(self, search: Search, share: float = 1.0, *, first: bool = True) -> None:
        self._search, self._most, self._first = search, share, first
        self._from, self._count = search.share, 0

    @property
    def done(self) -> float:
        """Share of these rounds' own budget that is spent, 0 to 1."""
        whole = max(self._most - self._from, 1e-12)
        return min(1.0, max(0.0, (self._search.share - self._from) / whole))

    def goes_on(self) -> bool:
        """Whether there is to be another round; call it before each."""
        now = self._search.share
        fits = now < self._most
        if self._count:
            # rounding must not refuse the last of the evaluations
            fits = now + (now - self._from) / self._count <= self._most + 1e-9
        elif self._first:
            fits = True
        self._count += 1
        return fits
