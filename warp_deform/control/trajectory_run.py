"""A plan of a trajectory as it is played: its actions, and what it has come to at its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .control_task import ControlTask
from .control_worlds import SOLVED_STEPS, ControlWorlds
from .recorded_path import Stretch, WalkedPath

__all__ = [
    "REST_STEPS",
    "DisplacedPath",
    "PlanRun",
    "counts_at_rest",
    "remaining",
    "settle",
    "things",
]

REST_STEPS = 20
"""Control steps after the end in which the tip has let go and waits, before the loss counts."""


def counts_at_rest(control: ControlWorlds) -> bool:
    """Whether a task's loss counts once everything is let go; swings count in motion."""
    task = control.task
    return not isinstance(task, ControlTask) or task.ends_when_solved


@dataclass(frozen=True, eq=False)
class DisplacedPath:
    """A walked path and how its holds are displaced (T + 1, 3) [m]."""

    path: WalkedPath
    displaced: np.ndarray


class PlanRun:
    """One episode as it goes: a plan's actions, each of which adds what is missing to its target.

    What is to be taken may lie elsewhere than in the recording, because it was put there faster. So
    the way to it is bent to where it is, and the way from there back to where it is to be. At its
    end the tip waits until the task was solved for as many steps running as end an episode, but no
    longer than the recording lasts.

    Args:
        slot: where its start was put
        steps: of the plan, or of the actions that are followed as they are
        longest: steps of the recording
    """

    def __init__(
        self,
        control: ControlWorlds,
        slot: int,
        steps: int,
        longest: int,
        plan: DisplacedPath | None = None,
    ) -> None:
        self.slot, self._control, self._plan = slot, control, plan
        self._steps, self._longest = steps, longest
        self._off, self._begun = np.zeros(3), np.zeros(3)
        self._solved, self._needed = 0, SOLVED_STEPS if counts_at_rest(control) else 1
        self._grip = control.grips[slot]
        self.actions: list[np.ndarray] = []
        self.taken: dict[int, tuple[int | None, int | None]] = {}
        """What the tip holds from the beginning of a step on, where that changes."""

    @property
    def lacks(self) -> int:
        """How many of the last steps are not solved that have to be."""
        return self._needed - min(self._solved, self._needed)

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        done = len(self.actions)
        if done < self._steps:
            return False
        return not self.lacks or done >= max(self._steps, self._longest)

    def note(self, action: np.ndarray) -> None:
        """Look at what a step has come to."""
        worlds, now = self._control.worlds, self._control.grips[self.slot]
        if now != self._grip:
            self._grip = self.taken[len(self.actions)] = now
        self.actions.append(action)
        if len(self.actions) > self._steps - self._needed:
            worlds.look(self.slot)
            self._solved = self._solved + 1 if worlds.solved(self.slot) else 0

    def next(self) -> np.ndarray:
        """The action (A,) float32 of the next control step."""
        assert self._plan is not None, "what is followed as it is has its actions"
        path = self._plan.path
        step = min(len(self.actions), path.steps - 1)
        k = path.stretch_at(step)
        stretch = path.stretches[k]
        if len(self.actions) == stretch.first:
            self._begun = self._off
        share = (step + 1 - stretch.first) / (stretch.last - stretch.first)
        if stretch.hold:
            self._off = (1 - share) * self._begun + self._plan.displaced[step + 1]
        elif k + 1 < len(path.stretches) and path.stretches[k + 1].place is not None:
            self._off = (1 - share) * self._begun + share * self._astray(path.stretches[k + 1])
        target = path.targets[step + 1].copy()
        target[:3] += self._off
        return self._towards(target, hold=stretch.hold)

    def _astray(self, stretch: Stretch) -> np.ndarray:
        """How far what is taken next is from where it was taken in the recording (3,) [m]."""
        particle, body = stretch.held
        q, body_q = things(self._control, self.slot)
        now = q[particle] if particle is not None else body_q[body or 0]
        return np.asarray(now - stretch.place)

    def _towards(self, target: np.ndarray, *, hold: bool) -> np.ndarray:
        control = self._control
        config, width = control.config, control.targets.width
        way = target - control.targets.asked[self.slot]
        move = way[:3] / (config.max_speed * config.seconds)
        move = move / max(1.0, float(np.linalg.norm(move)))
        turn = np.clip(way[3:] / (config.max_turn * config.seconds), -1, 1)
        numbers = [*move, *(turn if width > 4 else ()), 1.0 if hold else -1.0]
        return np.clip(np.array(numbers, np.float32), -1, 1)


def things(control: ControlWorlds, slot: int) -> tuple[np.ndarray, np.ndarray]:
    """Particles (P, 3) and bodies (B, 3) of a slot [m]."""
    solver = control.worlds.solver
    return solver.particle_q(slot).astype(float), solver.body_q(slot)[:, :3].astype(float)


def settle(control: ControlWorlds, slots: list[int]) -> np.ndarray:
    """Let go and wait, then what is left to do (n,); not a number where a guard has fired."""
    rest = np.zeros((len(slots), control.targets.width))
    rest[:, -1] = -1.0
    for _ in range(REST_STEPS):
        control.lead(slots, rest)
    return remaining(control, slots)


def remaining(control: ControlWorlds, slots: list[int]) -> np.ndarray:
    """What is left to do in slots (n,), see `Task.remaining`; not a number where a guard fired."""
    import torch

    worlds = control.worlds
    for slot in slots:
        worlds.look(slot)
    episodes = [worlds.episodes[slot] for slot in slots]
    arrays = [
        torch.from_numpy(np.stack([getattr(e.snapshot, name) for e in episodes]).astype(float))
        for name in ("particle_q", "body_q")
    ]
    with torch.no_grad():
        left = control.task.remaining(
            [e.layout for e in episodes], [e.snapshot for e in episodes], *arrays
        ).numpy()
    return np.where([e.physics_ok for e in episodes], left, np.nan)
