"""`HeldProblem`: plans with gradients, for tasks in which something is held from start to end."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import NOT_NEGATIVE, Interval, check_number
from .control_task import ControlTask
from .episode_problem import EpisodeProblem
from .plan_players import OpenPlayer, Player
from .plan_problem import in_parts
from .smooth_plans import KNOTS, numbers_of, tensor_actions_of

if TYPE_CHECKING:
    from torch import Tensor

    from .tensor_worlds import TensorControlWorlds

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_MOST = 1.0 - 1e-6
"""Length of an action that numbers can stand for at most."""


class HeldProblem(EpisodeProblem):
    """`EpisodeProblem` with gradients: `optimize` takes it with every method.

        problem = HeldProblem("push-cable", seeds=[10_000, 10_001])
        found = optimize(problem, "cem+adam", seconds=20)

    A descent goes on with three numbers a step, from the actions that the player makes of a plan.
    Its losses are those of `TensorControlWorlds`, which with bodies differ from `evaluate` by
    rounding; what is kept in the end has the environment's bits when it is played.

    Args:
        task: see `EpisodeProblem`, as are the others
        bundle: plans whose gradients are taken for one: the plan's own, and those of others near
            it. What counts is the mean of their directions, at the length of the own one, for the
            steepest would outweigh all others. Not for lbfgs, whose line search wants the slope of
            the loss; a budget in evaluations counts the own one alone. Source: bundled gradients
            (Suh, Pang, Tedrake, RA-L 2022)
        spread: of the others' numbers around the plan's, at six points in time

    Raises:
        InputError: the tip does not hold one thing from start to end, what `player` does depends on
            what it sees, `bundle` is less than 1, or `spread` negative.
    """

    def __init__(
        self,
        task: str | ControlTask,
        seeds: Sequence[int],
        *,
        player: Player | None = None,
        worlds: int = 16,
        bundle: int = 1,
        spread: float = 0.1,
    ) -> None:
        check_number(bundle, "bundle", Interval(low=1, whole=True))
        check_number(spread, "spread", NOT_NEGATIVE)
        super().__init__(task, seeds, player=player, worlds=worlds)
        self.bundle, self.spread = bundle, spread
        found = self.task
        if found.held_particle is None and found.held_body is None:
            raise InputError(f"{found.name} may take and let go, which has no derivative")
        if not isinstance(self.player, OpenPlayer):
            raise InputError("plans that depend on what is seen have no gradients here")
        self._tensors: TensorControlWorlds | None = None

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers (G, T, 3), three a step, of the plans that have numbers (G, *shape)."""
        player = self.player_of(numbers)
        assert isinstance(player, OpenPlayer), "it was looked at before"
        layouts = [start.layout for start in self.starts]
        moves = player.moves(numbers, layouts)
        lengths = np.linalg.norm(moves, axis=-1, keepdims=True)
        moves = moves * np.minimum(1.0, _MOST / np.maximum(lengths, _MOST))
        return np.asarray(moves / np.sqrt(1.0 - (moves**2).sum(axis=-1, keepdims=True)))

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Losses (n,) of plans (n, K, 3) for these goals (n,), and their gradients (n, K, 3).

        Where a guard fires the losses are inf, and the gradients mean nothing.
        """
        losses, gradients = self._parts(numbers, goals)
        if self.bundle == 1:
            return losses, gradients
        directions = _directions(losses, gradients)
        # drawn by the plans, so that a search finds the same whenever it is run
        rng = np.random.default_rng(zlib.crc32(numbers.tobytes()))
        for _ in range(self.bundle - 1):
            knots = rng.normal(0.0, self.spread, (len(goals), KNOTS, numbers.shape[2]))
            near = numbers + numbers_of(knots, numbers.shape[1])
            directions += _directions(*self._parts(near, goals))
        sizes = np.linalg.norm(gradients, axis=(1, 2), keepdims=True)
        return losses, sizes * directions / self.bundle

    def _parts(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return in_parts(self._gradients, goals, numbers, self.control.worlds.count)

    def _gradients(self, of: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import torch

        from .tensor_worlds import TensorControlWorlds

        count = self.control.worlds.count
        self._tensors = self._tensors or TensorControlWorlds(
            self.task, count, judged=self.task.ends_when_solved
        )
        worlds = self._tensors
        # slots without a plan play the last one again
        filled = np.concatenate([of, np.repeat(of[-1:], count - len(of))])
        worlds.reset({slot: self.seeds[goal] for slot, goal in enumerate(filled)})
        free = torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
        moves = tensor_actions_of(free, worlds.horizon)
        rest = moves[-1:].detach().expand(count - len(of), -1, -1)
        actions = torch.nn.functional.pad(torch.cat([moves, rest]), (0, 1), value=1.0)
        paid: list[Tensor] = []
        for row in actions.unbind(1):
            worlds.advance(row)
            if self._pays:
                paid.append(torch.exp(-(worlds.left + self.task.least_loss)))
        losses = worlds.left + self.task.least_loss
        if paid:
            losses = 1.0 - torch.stack(paid).sum(0) / worlds.horizon
        losses = losses[: len(of)]
        trusted = worlds.trusted[: len(of)]
        (gradients,) = torch.autograd.grad(losses[torch.from_numpy(trusted)].sum(), free)
        solved = np.array([worlds.worlds.solved(slot) for slot in range(len(of))])
        found = losses.detach().numpy() + self._unsolved(solved)
        worlds.detach()
        return np.where(trusted, found, np.inf), gradients.numpy()


def _directions(losses: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Gradients (n, K, 3) of length 1; of what cannot be used 0."""
    sizes = np.linalg.norm(gradients, axis=(1, 2))
    usable = np.isfinite(losses) & np.isfinite(sizes) & (sizes > 0.0)
    scale = np.where(usable, 1.0 / np.where(usable, sizes, 1.0), 0.0)
    return np.where(usable[:, None, None], gradients, 0.0) * scale[:, None, None]
