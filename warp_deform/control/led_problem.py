"""`LedProblem`: plans with gradients, for tasks in which something is held from start to end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .control_task import ControlTask
from .episode_problem import EpisodeProblem
from .plan_players import OpenPlayer, Player
from .smooth_plans import tensor_actions_of

if TYPE_CHECKING:
    from torch import Tensor

    from .tensor_worlds import TensorControlWorlds

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_MOST = 1.0 - 1e-6
"""Length of an action that numbers can stand for at most."""


class LedProblem(EpisodeProblem):
    """`EpisodeProblem` with gradients: `optimize` takes it with every method.

        problem = LedProblem("push-cable", seeds=[10_000, 10_001])
        found = optimize(problem, "cem+adam", seconds=20)

    A descent goes on with three numbers a step, from the actions that the player makes of a plan.
    Its losses are those of `TensorControlWorlds`, which with bodies differ from `evaluate` by
    rounding; what is kept in the end has the environment's bits when it is played.

    Args:
        task: see `EpisodeProblem`, as are the others

    Raises:
        InputError: the tip does not hold one thing from start to end, or what `player` does depends
            on what it sees.
    """

    def __init__(
        self,
        task: str | ControlTask,
        seeds: Sequence[int],
        *,
        player: Player | None = None,
        worlds: int = 16,
    ) -> None:
        super().__init__(task, seeds, player=player, worlds=worlds)
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
        room = self.control.worlds.count
        parts = [
            self._gradients(goals[first : first + room], numbers[first : first + room])
            for first in range(0, len(goals), room)
        ]
        losses, gradients = (np.concatenate(part) for part in zip(*parts, strict=True))
        return losses, gradients

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
        worlds.detach()
        return np.where(trusted, losses.detach().numpy(), np.inf), gradients.numpy()
