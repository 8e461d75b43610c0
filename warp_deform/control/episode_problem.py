"""`EpisodeProblem`: plans for the goals of seeds, of any task made for control, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..tasks.task import Layout
from ..worlds.state import WorldState
from .control_task import ControlTask
from .control_worlds import ControlWorlds
from .fold_fabric import CARRY_STEPS, FoldFabric1
from .fold_fabric_3 import FoldFabric3
from .held_cable import HeldCable
from .plan_players import (
    CornerPlayer,
    FoldPlayer,
    PathPlayer,
    Player,
    PushPlayer,
    SmoothPlayer,
)
from .push_cable import PushCable
from .unfold_fabric import UnfoldFabric1
from .wire import Wire

__all__ = ["PlayedPlans"]  # `warp_deform.control` has `EpisodeProblem`

_LANES = 8
_UNSOLVED = 100.0
"""More than any loss of a task that wants to be `solved_first`."""


@dataclass(frozen=True, eq=False)
class PlayedPlans:
    """What plans came to, each from the start of its seed.

    Attributes:
        losses: at the end (n,), see `ControlTask.losses`; not numbers where a guard has fired
        returns: sums over the steps of exp(-loss) (n,), DLO-Lab's return; up to a guard
        scores: at the end (n,)
        solved: at the end (n,)
        actions: (n, T, 4)
        particle_q: at the end (n, P, 3) [m]
    """

    losses: np.ndarray
    returns: np.ndarray
    scores: np.ndarray
    solved: np.ndarray
    actions: np.ndarray
    particle_q: np.ndarray


@dataclass(frozen=True, eq=False)
class _Start:
    """What an episode goes on from."""

    state: WorldState
    layout: Layout
    asked: np.ndarray
    floor: float
    grip: tuple[int | None, int | None]


class EpisodeProblem:
    """Plans for seeds of a task, as `optimize` takes them.

        problem = EpisodeProblem("gather", seeds=[10_000, 10_001])
        found = optimize(problem, "cem", evaluations=250)
        played = problem.play([0, 1], found.numbers)

    A plan's loss is the task's at its end, or of a task with DLO-Lab's return, what that lacks of 1
    a step. It has the bits of the environment of the same seed under the same actions in the mode
    "tip_delta_position", which goes on to its end here also when it was solved.

    Args:
        task: a name, or a `ControlTask`
        player: what the numbers of a plan mean; None: what suits the task
        worlds: that run side by side, a multiple of 8
        robot: whose reach limits the tip

    Raises:
        InputError: the task is not made for control, there are no seeds, or `worlds` is no multiple
            of 8.
    """

    def __init__(
        self,
        task: str | ControlTask,
        seeds: Sequence[int],
        *,
        player: Player | None = None,
        worlds: int = 16,
        robot: str = "ur5",
    ) -> None:
        if worlds < 1 or worlds % _LANES or not len(seeds):
            raise InputError(f"worlds must be a multiple of {_LANES}, and seeds one or more")
        self.control = ControlWorlds(task, worlds, robot=robot, lanes=_LANES)
        found = self.control.task
        if not isinstance(found, ControlTask):
            raise InputError(f"{found.name} is not made for control, so it has no plans")
        self.task, self.seeds = found, [int(seed) for seed in seeds]
        self.player = player or _player(found)
        self.starts = [self._start(seed) for seed in self.seeds]

    def _start(self, seed: int) -> _Start:
        control = self.control
        control.reset({0: seed})
        return _Start(
            control.worlds.state(0),
            control.worlds.episodes[0].layout,
            control.targets.asked[0].copy(),
            float(control.targets.floors[0]),
            control.grips[0],
        )

    @property
    def _pays(self) -> bool:
        return isinstance(self.task, HeldCable) and self.task.pays_on_the_way

    @property
    def goals(self) -> int:
        """Number of goals G."""
        return len(self.seeds)

    @property
    def shape(self) -> tuple[int, int]:
        """Of the free numbers of a plan."""
        return self.player.shape

    def player_of(self, numbers: np.ndarray) -> Player:
        """Who plays plans (n, K, M): the player, or motions with three free numbers in K steps."""
        if numbers.shape[-2:] == self.player.shape:
            return self.player
        return SmoothPlayer(self.control.horizon, numbers.shape[-2])

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        """What plans (G, N, *shape) lose (G, N), and searches make small; inf where a guard fires.

        It is the loss at the end, or what the return lacks where the task pays on the way, and for
        a task that wants to be `solved_first` 100 more where it is not solved.
        """
        count, each = numbers.shape[:2]
        of = np.repeat(np.arange(count), each)
        played = self.play(of, numbers.reshape(-1, *numbers.shape[2:]))
        losses = played.losses
        if self._pays:
            lacks = 1.0 - played.returns / self.control.horizon
            losses = np.where(np.isfinite(losses), lacks, np.inf)
        losses = losses + self._unsolved(played.solved)
        return np.where(np.isfinite(losses), losses, np.inf).reshape(count, each)

    def _unsolved(self, solved: np.ndarray) -> np.ndarray:
        """What plans (n,) lose by not solving."""
        return np.where(solved, 0.0, _UNSOLVED if self.task.solved_first else 0.0)

    def play(self, of: Sequence[int] | np.ndarray, numbers: np.ndarray) -> PlayedPlans:
        """Play plans (n, *shape), each for the goal of that number (n,)."""
        goals, room = np.asarray(of, dtype=int), self.control.worlds.count
        parts = [slice(first, first + room) for first in range(0, len(goals), room)]
        played = [self._played(goals[part], numbers[part]) for part in parts]
        return PlayedPlans(
            **{name: np.concatenate([getattr(p, name) for p in played]) for name in vars(played[0])}
        )

    def _played(self, of: np.ndarray, numbers: np.ndarray) -> PlayedPlans:
        control, slots = self.control, list(range(len(of)))
        worlds, solver = control.worlds, control.worlds.solver
        for slot, goal in zip(slots, of, strict=True):
            start = self.starts[goal]
            worlds.restore(slot, start.state)
            control.targets.place([slot], start.asked[None])
            control.targets.floors[slot], control.grips[slot] = start.floor, start.grip
        layouts = [worlds.episodes[slot].layout for slot in slots]
        player = self.player_of(numbers)
        player.begin(numbers, layouts)
        rows, returns = [], np.zeros(len(of))
        pays = isinstance(self.task, HeldCable)  # a return is told in any case
        for step in range(control.horizon):
            particle_q = np.stack([solver.particle_q(slot) for slot in slots])
            row = np.clip(player.rows(step, control.targets.asked[slots, :3], particle_q), -1, 1)
            rows.append(row)
            control.lead(slots, row)
            if pays:
                returns += np.nan_to_num(np.exp(-self._losses(slots)))
        losses = self._losses(slots)
        for slot in slots:
            worlds.look(slot)
        return PlayedPlans(
            losses,
            returns,
            np.array([worlds.score(slot) for slot in slots]),
            np.array([worlds.solved(slot) for slot in slots]),
            np.stack(rows, axis=1),
            np.stack([worlds.episodes[slot].snapshot.particle_q for slot in slots]),
        )

    def _losses(self, slots: Sequence[int]) -> np.ndarray:
        """The task's (n,); not numbers where a guard has fired."""
        import torch

        solver, episodes = self.control.worlds.solver, self.control.worlds.episodes
        layouts = [episodes[slot].layout for slot in slots]
        with torch.no_grad():
            q, body_q = (
                torch.from_numpy(np.stack([read(slot) for slot in slots]).astype(float))
                for read in (solver.particle_q, solver.body_q)
            )
            losses = self.task.losses(layouts, [], q, body_q).numpy()
        trusted = [episodes[slot].physics_ok for slot in slots]
        return np.where(trusted, losses, np.nan)


def _player(task: ControlTask) -> Player:
    """What suits a task."""
    if isinstance(task, PushCable):
        return PushPlayer(task.control, task.pushes)
    if isinstance(task, Wire):
        return PathPlayer(task.control, task.held_particle, task.horizon)
    if isinstance(task, UnfoldFabric1 | FoldFabric3):
        return CornerPlayer(task.control, task.fabric.columns, task.horizon // CARRY_STEPS)
    if isinstance(task, FoldFabric1):
        return FoldPlayer(task.control, task.fabric.columns, task.horizon // CARRY_STEPS)
    return SmoothPlayer(task.horizon)
