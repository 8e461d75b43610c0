"""Methods that descend: Adam on all goals side by side, and L-BFGS on each.

Derivatives of a swing are exact, and chaotic: those by the first knots may be 10,000 times as long
as those by the last. What can be trusted is their direction. So Adam gets each plan's derivatives
with the length 1, and the best plan on the way is kept, not the last.

Sources: Kingma and Ba, "Adam", ICLR 2015, by torch. Liu and Nocedal, "On the limited memory BFGS
method", 1989, by SciPy.
"""

from __future__ import annotations

import threading

import numpy as np

from .plan_problem import Rounds, Search

__all__ = ["adam", "lbfgs"]

_LR = 0.15
"""Adam's step size at first; it falls linearly to nothing."""
_BETAS = (0.7, 0.95)
"""Of its running means: short ones, for derivatives change their size a hundredfold on the way."""
_LOST = 1e6
"""What a plan that a guard ends counts for a line search, which needs a number."""


def adam(search: Search) -> None:
    """Descend from the best plans so far, with what is left of the budget.

    A plan that a guard ends goes back to the best one.
    """
    import torch

    search.refine()
    plans = torch.tensor(search.numbers)
    optimizer = torch.optim.Adam([plans], lr=_LR, betas=_BETAS)
    rounds = Rounds(search, first=not search.history)
    while rounds.goes_on():
        optimizer.param_groups[0]["lr"] = _LR * (1.0 - rounds.done)
        losses, slopes = search.descend(plans.numpy().copy())
        lengths = np.linalg.norm(slopes, axis=(1, 2), keepdims=True)
        plans.grad = torch.from_numpy(slopes / np.maximum(lengths, 1e-300))
        optimizer.step()
        lost = np.isinf(losses)
        plans[torch.from_numpy(lost)] = torch.from_numpy(search.numbers[lost])


def lbfgs(search: Search) -> None:
    """One L-BFGS a goal, each with its own line search; a goal that has converged stays there.

    SciPy's asks for one point at a time. So each runs in a thread of its own, and what all of them
    ask for is evaluated together, in lanes.
    """
    search.refine()
    queries = _Queries(search.numbers)
    threads = [
        threading.Thread(target=queries.minimize, args=(goal,), daemon=True)
        for goal in range(search.problem.goals)
    ]
    for thread in threads:
        thread.start()
    rounds = Rounds(search, first=not search.history)
    try:
        while queries.all_asked() and rounds.goes_on():
            queries.answer(*search.descend(queries.points.copy()))
    finally:
        queries.stop()
        for thread in threads:
            thread.join()


class _Stopped(Exception):
    """The budget is spent."""


class _Queries:
    """Points that threads ask about, and the answers to all of them.

    Attributes:
        points: of every goal the last one (G, K, 3)
    """

    def __init__(self, start: np.ndarray) -> None:
        self.points = start.copy()
        self._losses, self._slopes = np.zeros(len(start)), np.zeros_like(start)
        self._turn = threading.Condition()
        self._waiting = [False] * len(start)
        self._over = [False] * len(start)
        self._stopped = False

    def minimize(self, goal: int) -> None:
        """Minimise one goal's loss until it has converged or the budget is spent."""
        from scipy.optimize import minimize

        shape = self.points[goal].shape

        def ask(numbers: np.ndarray) -> tuple[float, np.ndarray]:
            with self._turn:
                self.points[goal] = numbers.reshape(shape)
                self._waiting[goal] = True
                self._turn.notify_all()
                self._turn.wait_for(lambda: self._stopped or not self._waiting[goal])
                if self._stopped:
                    raise _Stopped
                return float(self._losses[goal]), self._slopes[goal].ravel().copy()

        try:
            minimize(ask, self.points[goal].ravel(), jac=True, method="L-BFGS-B")
        except _Stopped:
            pass
        finally:
            with self._turn:
                self._over[goal] = True
                self._turn.notify_all()

    def all_asked(self) -> bool:
        """Wait until every goal's thread asks or is over; False where all are over."""
        with self._turn:
            self._turn.wait_for(
                lambda: all(w or o for w, o in zip(self._waiting, self._over, strict=True))
            )
            return not all(self._over)

    def answer(self, losses: np.ndarray, slopes: np.ndarray) -> None:
        """Tell everyone who asks."""
        with self._turn:
            self._losses = np.where(np.isfinite(losses), losses, _LOST)
            self._slopes = slopes
            self._waiting = [False] * len(self._waiting)
            self._turn.notify_all()

    def stop(self) -> None:
        """Let every thread end."""
        with self._turn:
            self._stopped = True
            self._turn.notify_all()
