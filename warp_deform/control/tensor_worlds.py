"""Episodes of control as functions of torch tensors: rewards and observations have a graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..episodes import Goal
from ..errors import InputError
from ..rollout.tensor_control import TensorControlLoop
from ..support.quaternion import quat_from_yaw
from .control_task import ControlTask
from .control_worlds import NOTHING, SOLVED_STEPS, ControlWorlds
from .held_history import HeldHistory

if TYPE_CHECKING:
    from ..tasks.task import Task
    from ..worlds.state import WorldState

__all__ = ["TensorStep"]  # `warp_deform.control` has `TensorControlWorlds`

_KEPT_STARTS = 4096
"""Starts that are kept, so that the same seeds begin again at little cost."""


@dataclass(frozen=True, eq=False)
class TensorStep:
    """What a control step did to all worlds (W).

    Attributes:
        rewards: with a graph (W,)
        terminated: (W,) bool
        truncated: (W,) bool
        success: (W,) bool
    """

    rewards: torch.Tensor
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray


@dataclass(frozen=True, eq=False)
class _Start:
    """An episode's first state, what the tip holds in it, its target, and its floor [m]."""

    state: WorldState
    grip: tuple[int | None, int | None]
    asked: np.ndarray
    floor: float


class TensorControlWorlds(ControlWorlds):
    """`ControlWorlds` whose steps take and give tensors, with derivatives through whole episodes.

        worlds = TensorControlWorlds("whip-target", 8)
        worlds.reset({slot: slot for slot in range(8)})
        for _ in range(20):
            done = worlds.advance(policy(worlds.observe()))
            loss = loss - done.rewards.sum()
        loss.backward()

    States, observations, rewards and ends are those of `ControlWorlds`; of swings to the bit. What
    is held is a choice that has no derivative, so it is held from the start. It may be let go, but
    nothing can be taken again. A step is recorded while gradients are enabled and something needs
    them; `detach` frees what is recorded, and so does a reset of all worlds.

    Args:
        task: see `ControlWorlds`, as are the others
        memory: most bytes of what is recorded
        judged: whether every step says what is solved. For searches that do not ask: whether a
            cable has a knot takes longer to tell than the step that led it there

    Raises:
        InputError: nothing is held from the start, another mode than "tip_delta_position", rewards
            that have no derivative, or a task that ends when it is solved is not judged.
    """

    def __init__(
        self,
        task: str | Task,
        count: int = 1,
        *,
        memory: int = 2**30,
        judged: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(task, count, **options)
        self.judged = judged
        if not judged and self._ends_when_solved:
            raise InputError(f"{self.task.name} ends when it is solved: it has to be judged")
        if self.targets.mode != "tip_delta_position":
            raise InputError(
                f"derivatives are there in control_mode tip_delta_position, not {self.targets.mode}"
            )
        if self.rewards.mode not in ("dense", "normalized_dense"):
            raise InputError(
                f"reward_mode {self.rewards.mode} has no derivative: choose dense or "
                "normalized_dense"
            )
        if self._held == NOTHING and self.start != "held":
            raise InputError('what is taken hold of has no derivative: choose start="held"')
        self._tensors = TensorControlLoop(self.worlds.solver, rate=self.config.rate, memory=memory)
        self.beyond = torch.zeros(count, dtype=torch.float64)
        """How far the last targets lay from where the tips were led for them (W,) [m].

        What presses against a limit has no slope there: this leads it back."""
        self._starts: dict[int, _Start] = {}
        self._live = np.zeros(count, bool)
        self._asked = torch.zeros(count, 4, dtype=torch.float64)
        self._sent = torch.zeros(count, 4, dtype=torch.float64)
        self._floors = torch.zeros(count, dtype=torch.float64)
        self._actions = torch.zeros(count, self.targets.width, dtype=torch.float64)
        self._left = torch.zeros(count, dtype=torch.float64)
        self._at_first = torch.ones(count, dtype=torch.float64)

    def holding(self, slot: int) -> bool:
        """Whether the tip of a slot holds something."""
        return self.grips[slot] != NOTHING

    @property
    def trusted(self) -> np.ndarray:
        """In which worlds no guard has fired (W,) bool."""
        return np.array([self.worlds.episodes[s].physics_ok for s in range(self.worlds.count)])

    @property
    def running(self) -> np.ndarray:
        """In which worlds an episode goes on (W,) bool; the others pause until they are reset."""
        return self._live.copy()

    @property
    def left(self) -> torch.Tensor:
        """What is left to do in every world (W,), see `Task.remaining`."""
        return self._left

    # -- starting

    def reset(self, seeds: Mapping[int, int], *, goals: Mapping[int, Goal] | None = None) -> None:
        """Start the episodes that the seeds name; the first time in all slots.

        The starts of seeds are kept, so that they begin again at little cost.
        """
        slots = list(seeds)
        running = [slot for slot in slots if self._live[slot]]
        if running:
            self._tensors.end(running)
            self._live[running] = False
        given = goals or {}
        new = {s: seed for s, seed in seeds.items() if seed not in self._starts or s in given}
        starts = {slot: self._starts[seed] for slot, seed in seeds.items() if slot not in new}
        if new:
            super().reset(new, goals=goals)
            for slot, seed in new.items():
                starts[slot] = start = self._start_of(slot)
                if slot not in given and len(self._starts) < _KEPT_STARTS:
                    self._starts[seed] = start
            self.tips.end(list(new))
        self.worlds.solver.config = self._led_config
        for slot in slots:
            self._put(slot, starts[slot])
        # a loop in which nothing runs begins anew, and then in all of its worlds
        anew = not self._live.any()
        self._tensors.begin(list(range(self.worlds.count)) if anew else slots)
        if anew:
            self._cut()
        self._live[slots] = True
        for slot in slots:
            particle, body = starts[slot].grip
            # the middle of a held particle is the tip, as it is without derivatives
            tip = None if self._held[0] is not None else starts[slot].asked
            self._tensors.hold(
                slot,
                particle=particle,
                body=body,
                tip=None if tip is None else tip[:3],
                rotation=None if tip is None else quat_from_yaw(float(tip[3])),
            )
        self._note_start(slots)

    def _start_of(self, slot: int) -> _Start:
        return _Start(
            # before its end, which stops what is held
            state=replace(self.worlds.state(slot), run=None),
            grip=self.grips[slot],
            asked=self.targets.asked[slot].copy(),
            floor=float(self.targets.floors[slot]),
        )

    def _put(self, slot: int, start: _Start) -> None:
        """Put a slot to a start; what is held is held afterwards."""
        self.worlds.restore(slot, start.state)
        self.targets.place([slot], start.asked[None])
        self.targets.floors[slot] = start.floor
        self.grips[slot] = start.grip
        self._carried[slot] = HeldHistory()
        self._note_taken(slot)
        self.steps[slot] = self._solved[slot] = 0

    def _note_start(self, slots: list[int]) -> None:
        """Note where tips are, and what is left to do, as numbers without a graph."""
        at = torch.tensor(slots)
        tips = torch.from_numpy(self.targets.asked[slots])
        self._asked, self._sent = self._asked.clone(), self._sent.clone()
        self._asked[at] = self._sent[at] = tips
        self._floors = torch.from_numpy(self.targets.floors.copy())
        self._actions = self._actions.clone()
        self._actions[at] = 0.0
        with torch.no_grad():
            left = self._remaining(np.isin(np.arange(self.worlds.count), slots), self._left)
        self._left, self._at_first = self._left.clone(), self._at_first.clone()
        self._left[at] = left[at]
        self._at_first[at] = left[at].clamp(min=1e-6)

    # -- going on

    def advance(self, actions: torch.Tensor) -> TensorStep:
        """Run one control step in every world whose episode goes on; the others pause.

        Args:
            actions: (W, 4), each number from -1 to 1

        Raises:
            InputError: another shape, or nothing was reset.
        """
        if tuple(actions.shape) != tuple(self._actions.shape):
            shape = tuple(self._actions.shape)
            raise InputError(f"actions have the shape {shape}, not {tuple(actions.shape)}")
        if not self.worlds.episodes:
            raise InputError("no episode runs: reset first")
        actions = actions.double()
        numbers = actions.detach().numpy()
        live = self._live.copy()
        slots = np.flatnonzero(live).tolist()
        keeps = isinstance(self.task, ControlTask) and self.task.keeps_hold
        for slot in slots:
            if self.holding(slot) and not keeps and not numbers[slot, -1] > 0:
                self._let_go(slot)
        if slots:
            self._tensors.advance(self._led_to(slots, actions, numbers))
        self.steps[slots] += 1
        for slot in slots:
            self._note(slot)
        step = self._paid(live, self.trusted, actions)
        over = np.flatnonzero(step.terminated | step.truncated).tolist()
        if over:
            self._tensors.end(over)
            self._live[over] = False
        return step

    def _let_go(self, slot: int) -> None:
        self._tensors.let_go(slot, release=self.release)
        self.grips[slot] = NOTHING
        self._carried[slot].let_go(self.worlds.episodes[slot])
        self._set_floor(slot)
        self._floors = torch.from_numpy(self.targets.floors.copy())

    def _led_to(self, slots: list[int], actions: torch.Tensor, numbers: np.ndarray) -> torch.Tensor:
        """Where tips are led (W, 3) [m]: values of the environment, derivatives of torch."""
        values = self._sent.detach().numpy().copy()
        values[slots] = self.targets.follow(slots, numbers[slots])[:, -1]
        moves = actions[:, :3]
        moves = moves / torch.linalg.vector_norm(moves, dim=1, keepdim=True).clamp(min=1.0)
        step = torch.nn.functional.pad(moves, (0, 1)) * (
            self.config.max_speed * self.config.seconds
        )
        wanted = self._asked + step
        asked = self.limits.kept(wanted, self._floors)
        sent = self.limits.project(asked, self._floors)
        self.beyond = (wanted - sent)[:, :3].norm(dim=1)
        self._asked = _valued(asked, self.targets.asked)
        self._sent = _valued(sent, values)
        return self._sent[:, :3]

    def _note(self, slot: int) -> None:
        episode = self.worlds.episodes[slot]
        episode.tip = self._sent[slot].detach().numpy().copy()
        episode.sim_seconds += self.tips.loop.seconds
        episode.problems = self._tensors.problems.get(slot, ()) or episode.problems
        self.worlds.look(slot)
        self._carried[slot].follow(episode, self.task)

    def _paid(self, live: np.ndarray, trusted: np.ndarray, actions: torch.Tensor) -> TensorStep:
        """Rewards and ends after a step."""
        fine = live & trusted
        left = self._remaining(fine, self._left)
        if self.rewards.mode == "dense":
            rewards = (self._left - left) / self._at_first
        else:
            rewards = torch.exp(-left.clamp(min=0.0) / self._at_first)
        later = torch.from_numpy(self.steps > 1)
        change = ((actions - self._actions) ** 2).sum(dim=1)
        rewards = rewards - self.action_penalty * torch.where(later, change, 0.0)
        rewards = torch.where(torch.from_numpy(fine), rewards, 0.0)
        self._left, self._actions = left, actions
        asked = live & self.judged
        success = np.array([bool(asked[s]) and self.worlds.solved(s) for s in range(len(live))])
        self._solved = np.where(success, self._solved + 1, 0)
        done = self._ends_when_solved & (self._solved >= SOLVED_STEPS)
        terminated = live & (~trusted | done)
        truncated = live & ~terminated & (self.steps >= self.horizon)
        return TensorStep(rewards, terminated, truncated, success)

    def _remaining(self, rows: np.ndarray, otherwise: torch.Tensor) -> torch.Tensor:
        """What is left to do (W,); of other rows what it was before."""
        slots = np.flatnonzero(rows).tolist()
        if not slots:
            return otherwise
        episodes = [self.worlds.episodes[slot] for slot in slots]
        at, state = torch.tensor(slots), self._tensors.state
        left = self.task.remaining(
            [episode.layout for episode in episodes],
            [episode.snapshot for episode in episodes],
            state.positions.double()[at],
            state.body_poses.double()[at],
        )
        return otherwise.index_copy(0, at, left)

    def observe(self) -> torch.Tensor:
        """What "state" shows of every world (W, D) float32; 0 where a state is not finite."""
        state, count = self._tensors.state, self.worlds.count
        tips = self._sent[:, None, :3]
        goals = [self.worlds.episodes[slot].layout.targets for slot in range(count)]
        holding = np.array([[float(self.holding(slot))] for slot in range(count)])
        parts = (
            self._sent, torch.from_numpy(holding), state.positions.double() - tips,
            state.velocities.double(), state.body_poses.double(),
            torch.from_numpy(np.stack(goals).astype(float)),
            torch.from_numpy(self.steps[:, None] / self.horizon),
        )  # fmt: skip
        flat = torch.cat([part.reshape(count, -1) for part in parts], dim=1).float()
        return torch.where(torch.isfinite(flat).all(dim=1, keepdim=True), flat, 0.0)

    def detach(self) -> None:
        """Cut the graph here, and free what is recorded: what follows knows nothing of before."""
        self._tensors.detach()
        self._cut()

    def _cut(self) -> None:
        for name in ("_asked", "_sent", "_left", "_actions"):
            setattr(self, name, getattr(self, name).detach())


def _valued(tensor: torch.Tensor, values: np.ndarray) -> torch.Tensor:
    """A tensor with its derivatives, and other values: the same but for the last bits."""
    return torch.from_numpy(values.copy()) + (tensor - tensor.detach())
