"""Methods that descend: Adam on all goals side by side, and L-BFGS on each.

Gradients of a swing are exact, and chaotic: those by the first knots may be 10,000 times as long
as those by the last. What can be trusted is their direction. So Adam gets each plan's gradient
with the length 1, and the best plan on the way is kept, not the last.

Many a descent ends in a hollow that is not the deepest. So once all have descended, the worst of
them start again from another plan, and the worst after these, and so on.

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
_STAGES = ((1.0, 0.45), (0.5, 0.67), (0.3, 0.8), (0.2, 0.93), (0.1, 1.0))
"""Share of the goals that descend, the worst ones, and the share of the budget spent after it."""
_LOST = 1e6
"""What a plan that a guard ends counts for a line search, which needs a number."""


def adam(search: Search) -> None:
    """Descend from the best plans so far, with what is left of the budget.

    The worst start again from those that were drawn first, one after the other.
    """
    search.refine()
    whole, begun = 1.0 - search.share, search.share
    for number, (share, until) in enumerate(_STAGES):
        count = max(1, round(share * search.problem.goals))
        goals = np.sort(np.argsort(-search.losses, kind="stable")[:count])
        plans = search.numbers[goals]
        if number and search.first is not None:
            again = search.first[:, min(number, search.first.shape[1] - 1)]
            plans = search.refined(again)[goals]
        _descend(search, goals, plans, until=begun + until * whole)


def _descend(search: Search, goals: np.ndarray, start: np.ndarray, *, until: float) -> None:
    """Adam for some goals, from plans (n, K, 3) until so much of the budget is spent.

    A plan that a guard ends goes back to the best one.
    """
    import torch

    plans = torch.tensor(start)
    optimizer = torch.optim.Adam([plans], lr=_LR, betas=_BETAS)
    rounds = Rounds(search, until, first=not search.history)
    while rounds.goes_on():
        optimizer.param_groups[0]["lr"] = _LR * (1.0 - rounds.done)
        losses, gradients = search.descend(plans.numpy().copy(), goals)
        lengths = np.linalg.norm(gradients, axis=(1, 2), keepdims=True)
        plans.grad = torch.from_numpy(gradients / np.maximum(lengths, 1e-300))
        optimizer.step()
        lost = np.isinf(losses)
        plans[torch.from_numpy(lost)] = torch.from_numpy(search.numbers[goals[lost]])


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
    rounds, goals = Rounds(search, first=not search.history), np.arange(search.problem.goals)
    try:
        while queries.all_asked() and rounds.goes_on():
            queries.answer(*search.descend(queries.points.copy(), goals))
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
        self._losses, self._gradients = np.zeros(len(start)), np.zeros_like(start)
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
                return float(self._losses[goal]), self._gradients[goal].ravel().copy()

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

    def answer(self, losses: np.ndarray, gradients: np.ndarray) -> None:
        """Tell everyone who asks."""
        with self._turn:
            self._losses = np.where(np.isfinite(losses), losses, _LOST)
            self._gradients = gradients
            self._waiting = [False] * len(self._waiting)
            self._turn.notify_all()

    def stop(self) -> None:
        """Let every thread end."""
        with self._turn:
            self._stopped = True
            self._turn.notify_all()
