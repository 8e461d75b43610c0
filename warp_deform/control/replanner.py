"""`Replanner`: a closed loop that plans the rest of a swing again at every control step.

A plan meets its goal as well as the simulator meets what it is played on. So at every step the rest
of the plan begins where the cable is now, descends a few times along its gradient through the
simulator, and gives its next move: model predictive control, whose search is a gradient.

Sources: Rawlings, Mayne and Diehl, Model Predictive Control (2017), section 1.3; the plan of the
step before, less its first move, as the start of the next one is its section 2.7's warm start.
"""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .swing_problem import SwingProblem

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_LR = 0.1
"""Adam's step size in the first round of a step; it falls linearly to nothing."""
_BETAS = (0.7, 0.95)
"""Of its running means, as in `plan_descent`."""


class Replanner:
    """Observations "state" of swings in, the next actions out; one row for each of the goals.

        problem = SwingProblem("whip-target", seeds)
        plans = optimize(problem, seconds=0.2 * len(seeds))
        act = Replanner(problem, plans.numbers)
        worlds = TensorControlWorlds("whip-target", len(seeds))
        worlds.reset(dict(enumerate(seeds)))
        while worlds.running.any():
            worlds.advance(torch.from_numpy(act(worlds.observe().numpy())))

    The best rest of a plan that a step has tried is kept, the one of the step before among them. So
    where nothing disturbs a swing, its plan gets no worse, but for a millimetre or two: plans that
    begin amid a swing list contacts anew.

    Args:
        problem: whose goals the rows are, in their order
        numbers: free numbers of the plans to begin with (G, K, 3), of any number K
        rounds: gradients of every goal at every step; 0 plays the plans as they are

    Raises:
        InputError: numbers of another shape or not finite, or no such number of rounds.
    """

    def __init__(self, problem: SwingProblem, numbers: np.ndarray, *, rounds: int = 8) -> None:
        given = np.asarray(numbers, dtype=float)
        if given.ndim != 3 or len(given) != problem.goals or given.shape[2] != 3:
            raise InputError(
                f"numbers must have the shape ({problem.goals}, K, 3), not {given.shape}"
            )
        if not np.isfinite(given).all():
            raise InputError("numbers must be finite")
        if type(rounds) is not int or rounds < 0:
            raise InputError(f"rounds is a number of gradients, 0 or more, not {rounds!r}")
        self.problem, self.rounds = problem, rounds
        self._horizon = problem.horizon
        self._first = problem.refined(given)
        self.rest = self._first
        """Numbers (G, T - t, 3) of the moves that are still to come."""
        self._step = 0
        self._over = np.zeros(len(given), bool)

    def __call__(self, seen: np.ndarray) -> np.ndarray:
        """Actions (G, 4) of "tip_delta_position".

        Args:
            seen: what "state" shows of each goal's episode (G, D), all of them at the same step.
                One that stays behind is over, as after a guard: its action means nothing

        Raises:
            InputError: another shape, or episodes that are not at the step that follows.
        """
        seen = np.asarray(seen, dtype=float)
        goals, count = self.problem.goals, self.problem.particles
        if seen.ndim != 2 or len(seen) != goals or seen.shape[1] < 6 + 6 * count:
            raise InputError(
                f'seen must be what "state" shows of {goals} episodes, not {seen.shape}'
            )
        steps = np.rint(seen[:, -1] * self._horizon).astype(int)
        if (steps == 0).all():
            self._step, self.rest = 0, self._first
            self._over = np.zeros(goals, bool)
        if self._step == self._horizon:
            raise InputError(f"an episode has {self._horizon} steps: reset all of them")
        self._over = self._over | (steps == self._step - 1)
        if (steps[~self._over] != self._step).any():
            shown = sorted(set(steps[~self._over].tolist()))
            raise InputError(f"step {self._step} of every episode follows, not steps {shown}")
        if self.rounds and self._step and not self._over.all():
            tips, beads = seen[:, :4], seen[:, 5:].reshape(goals, -1)
            places = beads[:, : 3 * count].reshape(goals, count, 3) + tips[:, None, :3]
            velocities = beads[:, 3 * count : 6 * count].reshape(goals, count, 3)
            left = self._horizon - self._step
            with self.problem.begun_at(places, velocities, tips, steps=left):
                self._descend(np.flatnonzero(~self._over))
        moves = self.rest[:, 0] / np.sqrt(1.0 + (self.rest[:, 0] ** 2).sum(axis=1, keepdims=True))
        self.rest, self._step = self.rest[:, 1:], self._step + 1
        return np.pad(moves, ((0, 0), (0, 1)), constant_values=1.0)

    def _descend(self, goals: np.ndarray) -> None:
        """Keep the best rests of these goals' plans in a few rounds of Adam.

        Each goes along its gradient's direction, as in `plan_descent`.
        """
        import torch

        best, least = self.rest[goals], np.full(len(goals), np.inf)
        plans = torch.tensor(best)
        optimizer = torch.optim.Adam([plans], lr=_LR, betas=_BETAS)
        for number in range(self.rounds):
            losses, gradients = self.problem.gradients(plans.numpy().copy(), goals)
            better = losses < least
            best[better], least[better] = plans.numpy()[better], losses[better]
            lengths = np.linalg.norm(gradients, axis=(1, 2), keepdims=True)
            usable = np.isfinite(lengths) & np.isfinite(losses)[:, None, None]
            ways = np.where(usable, gradients, 0.0) / np.where(usable, lengths + 1e-300, 1.0)
            optimizer.param_groups[0]["lr"] = _LR * (1.0 - number / self.rounds)
            plans.grad = torch.from_numpy(ways)
            optimizer.step()
        self.rest = self.rest.copy()
        self.rest[goals] = best
