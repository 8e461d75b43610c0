"""`TrajectoryProblem`: a recorded episode of control, as a problem of making it better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.quaternion import quat_from_yaw
from .control_worlds import SOLVED_STEPS, ControlWorlds
from .episode_start import put_start, start_of
from .recorded_path import (
    RecordedPath,
    Stretch,
    WalkedPath,
    cut,
    hats,
    held_stretches,
    roughness,
    walked,
)
from .trajectory_measures import LEAST_LOSS, Measures, Walk
from .trajectory_run import (
    REST_STEPS,
    DisplacedPath,
    PlanRun,
    counts_at_rest,
    remaining,
    settle,
    things,
)

if TYPE_CHECKING:
    from torch import Tensor

    from ..rollout.tensor_control import TensorControlLoop

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_FASTEST_FREE, _FASTEST_HELD = 3.0, 6.0
"""How many times as fast as recorded a tip may get: where it is empty, and where it holds."""
_UNIT = 0.002
"""Displacement [m] that a free number of 1 stands for."""
_KNOTS_A_HOLD = 2
"""Displacements of each hold that a search has."""
_EVERY = 4
"""A descent has one for so many recorded steps, at any pace, so that plans can be compared."""
_WORSE = 4.0
"""What an excess over the recording weighs beside a gain, so that nothing gets worse for long."""


class TrajectoryProblem:
    """Plans around one recorded episode, as `optimize` takes them: shorter, more exact, smoother.

    A plan's numbers are, in its first row, the paces of the empty and of the loaded tip and the
    weight of the smoothing; then displacements of every hold, a few for a search and many for a
    descent. What was taken is followed to where it is. The loss is the mean of three ratios to the
    recording, those of `Measures`; so the recording has 1. A plan that is worse in any of them, or
    in its score, has more than 1, and one at whose end the task is not solved, step after step and
    again at rest, more than 2.

    Args:
        control: worlds in the mode of the recording; they are reset
        seed: of the episode
        actions: that were recorded (T, A)

    Raises:
        InputError: the mode adds nothing to the last target, or a guard fires at the recording.
    """

    def __init__(self, control: ControlWorlds, seed: int, actions: np.ndarray) -> None:
        if not control.targets.mode.startswith("tip_delta"):
            raise InputError(
                f"paths are refined in the modes of tip_delta, not {control.targets.mode}"
            )
        self.control, self.seed = control, seed
        self.at_rest = counts_at_rest(control)
        control.reset({0: seed})
        self.start = start_of(control, 0)
        self.path = self._recorded(np.asarray(actions, dtype=float))
        self._holds = held_stretches(self.path.stretches)
        self.longest = len(actions)
        self.recorded = self.follow(np.asarray(actions, np.float32))
        if self.recorded.measures is None:
            raise InputError(f"a guard fires in the recorded episode of seed {seed}")
        self._loop: TensorControlLoop | None = None

    def _recorded(self, actions: np.ndarray) -> RecordedPath:
        """Play the recording in slot 0, and note where tips and things are."""
        control = self.control
        targets = [control.targets.asked[0].copy()]
        runs = cut((actions[:, -1] > 0).tolist())
        stretches = []
        for first, last, hold in runs:
            q, body_q = things(control, 0)
            for step in range(first, last):
                control.lead([0], actions[step][None])
                targets.append(control.targets.asked[0].copy())
            held = control.grips[0] if hold else (None, None)
            particle, body = held
            place = None
            if particle is not None:
                place = q[particle]
            elif body is not None:
                place = body_q[body]
            stretches.append(Stretch(first, last, hold, held, place))
        return RecordedPath(np.array(targets), tuple(stretches))

    @property
    def goals(self) -> int:
        """One: the episode's."""
        return 1

    @property
    def shape(self) -> tuple[int, int]:
        """Of the free numbers of a plan."""
        return 1 + _KNOTS_A_HOLD * len(self._holds), 3

    # -- plans of numbers

    def _plan(self, numbers: np.ndarray) -> DisplacedPath:
        """The plan that numbers (K, 3) stand for; those beyond `shape` displace it finely."""
        few = self.shape[0]
        share = 1.0 / (1.0 + np.exp(-numbers[0, :2]))
        share *= self.at_rest  # a swing lasts as long as it does
        config = self.control.config
        path = walked(
            self.path,
            free=float(_FASTEST_FREE ** share[0]),
            held=float(_FASTEST_HELD ** share[1]),
            smoothing=float(10.0 ** np.clip(numbers[0, 2], -3, 3)),
            stride=config.max_speed * config.seconds,
        )
        displaced = self._basis(path, fine=False) @ numbers[1:few]
        if len(numbers) > few:
            displaced = displaced + self._basis(path, fine=True) @ numbers[few:]
        return DisplacedPath(path, _UNIT * displaced)

    def _basis(self, path: WalkedPath, *, fine: bool) -> np.ndarray:
        """Shares (T + 1, K) of knots in the displacements of every step's end."""
        parts = []
        for k in self._holds:
            stretch = path.stretches[k]
            steps = stretch.last - stretch.first
            recorded = self.path.stretches[k].last - self.path.stretches[k].first
            shares = hats(steps, max(1, round(recorded / _EVERY)) if fine else _KNOTS_A_HOLD)
            part = np.zeros((path.steps + 1, shares.shape[1]))
            part[stretch.first : stretch.last + 1] = shares
            parts.append(part)
        return np.concatenate(parts, axis=1) if parts else np.zeros((path.steps + 1, 0))

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers of the same plan (1, K', 3) with finer displacements of what is held."""
        count = self._basis(self._plan(numbers[0]).path, fine=True).shape[1]
        return np.concatenate([numbers, np.zeros((1, count, 3))], axis=1)

    # -- playing

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        """Losses (1, N) of plans (1, N, K, 3); inf where a guard fires."""
        return np.array([[self.loss(walk) for walk in self.walks(numbers[0])]])

    def loss(self, walk: Walk) -> float:
        """What is searched for the least of."""
        if walk.measures is None:
            return np.inf
        before = self.recorded
        assert before.measures is not None, "it was looked at before"
        ratios = walk.measures.over(before.measures)
        excess = np.maximum(0.0, ratios - 1.0).mean() + max(0.0, before.score - walk.score)
        lacks = walk.lacks + (before.rests and not walk.rests)
        return float(
            ratios.mean()
            + (1.0 + _WORSE * excess if excess > 0.0 else 0.0)
            + (2.0 + lacks / SOLVED_STEPS if lacks else 0.0)
        )

    def walks(self, numbers: np.ndarray) -> list[Walk]:
        """What plans (N, K, 3) come to."""
        room = self.control.worlds.count
        plans = [self._plan(each) for each in numbers]
        return [
            walk
            for first in range(0, len(plans), room)
            for walk in self._walked(plans[first : first + room])
        ]

    def follow(self, actions: np.ndarray) -> Walk:
        """What actions (T, A) come to, as they are."""
        put_start(self.control, 0, self.start)
        run = PlanRun(self.control, 0, len(actions), len(actions))
        for row in actions:
            self.control.lead([0], row[None])
            run.note(row)
        return self._ended([run])[0]

    def _walked(self, plans: Sequence[DisplacedPath]) -> list[Walk]:
        for slot in range(len(plans)):
            put_start(self.control, slot, self.start)
        runs = [self._run(slot, plan) for slot, plan in enumerate(plans)]
        while live := [run for run in runs if not run.over]:
            rows = np.stack([run.next() for run in live])
            self.control.lead([run.slot for run in live], rows)
            for run, row in zip(live, rows, strict=True):
                run.note(row)
        return self._ended(runs)

    def _run(self, slot: int, plan: DisplacedPath) -> PlanRun:
        return PlanRun(self.control, slot, plan.path.steps, self.longest, plan)

    def _ended(self, runs: Sequence[PlanRun]) -> list[Walk]:
        slots = [run.slot for run in runs]
        losses = settle(self.control, slots) if self.at_rest else remaining(self.control, slots)
        out = []
        for run, loss in zip(runs, losses, strict=True):
            rows = np.stack(run.actions)
            measures = (
                Measures(len(rows), float(loss), roughness(rows)) if np.isfinite(loss) else None
            )
            worlds = self.control.worlds
            rests, score = worlds.solved(run.slot), float(worlds.score(run.slot))
            out.append(Walk(rows, measures, run.lacks, rests, score))
        return out

    # -- derivatives

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Loss (1,) of the plan (1, K, 3), and its gradient by the displacements.

        The loss has the bits of `evaluate`. The gradient is that of the same path with what was
        taken held, by the part that the displacements have in it; pace and smoothing have none.
        """
        import torch

        plan = self._plan(numbers[0])
        put_start(self.control, 0, self.start)
        run = self._run(0, plan)
        sent = []
        while not run.over:
            row = run.next()
            self.control.lead([0], row[None])
            run.note(row)
            sent.append(self.control.targets.sent([0])[0])
        walk = self._ended([run])[0]
        loss = self.loss(walk)
        gradients = np.zeros_like(numbers)
        if walk.measures is None:
            return np.array([loss]), gradients
        free = torch.tensor(numbers[0, 1:], dtype=torch.float64, requires_grad=True)
        basis = np.concatenate(
            [self._basis(plan.path, fine=False), self._basis(plan.path, fine=True)], axis=1
        )[:, : len(free)]
        # what waits at the end stays displaced as it was
        rows = np.minimum(np.arange(len(sent) + 1), plan.path.steps)
        moved = _UNIT * (torch.from_numpy(basis[rows]) @ free)
        way = moved - moved.detach()
        left = self._left(run, np.array(sent), way)
        before = self.recorded.measures
        assert before is not None, "it was looked at before"
        rough = self._rough(walk.actions, way)
        least = max(before.loss, LEAST_LOSS)
        wanted = left.clamp(min=LEAST_LOSS) / least + rough / max(before.roughness, 1e-9)
        (by,) = torch.autograd.grad(wanted, free)
        gradients[0, 1:] = by.numpy()
        return np.array([loss]), gradients

    def _rough(self, actions: np.ndarray, way: Tensor) -> Tensor:
        """`roughness` of actions, with derivatives by the displacements of targets (T + 1, 3)."""
        import torch

        stride = self.control.config.max_speed * self.control.config.seconds
        moves = torch.from_numpy(actions[:, :3].astype(float)) + way.diff(dim=0) / stride
        moves = torch.nn.functional.pad(moves, (0, 0, 1, 1))
        return (moves.diff(dim=0) ** 2).sum()

    def _left(self, run: PlanRun, sent: np.ndarray, way: Tensor) -> Tensor:
        """What is left to do, with derivatives by the displacements of targets (T + 1, 3)."""
        import torch

        from ..rollout.tensor_control import TensorControlLoop

        control = self.control
        put_start(control, 0, replace(self.start, state=replace(self.start.state, run=None)))
        loop = self._loop = self._loop or TensorControlLoop(
            control.worlds.solver, rate=control.config.rate
        )
        loop.begin([0])
        if self.path.stretches[0].hold and self.start.grip != (None, None):
            self._take(loop, self.start.grip, self.start.asked)
        turns = quat_from_yaw(sent[:, 3])
        for step in range(len(sent)):
            taken = run.taken.get(step)
            if taken is not None:
                loop.let_go(0, release=control.release)
                if taken != (None, None):
                    self._take(loop, taken, sent[step - 1] if step else self.start.asked)
            target = torch.from_numpy(sent[step, :3]) + way[step + 1]
            state = loop.advance(target[None], torch.from_numpy(turns[step])[None])
        if self.at_rest:
            loop.let_go(0, release=control.release)
            for _ in range(REST_STEPS):
                state = loop.advance()
        loop.end()
        episode = control.worlds.episodes[0]
        left = control.task.remaining(
            [episode.layout], [episode.snapshot], state.positions.double(),
            state.body_poses.double(),
        )  # fmt: skip
        return left[0]

    def _take(
        self, loop: TensorControlLoop, held: tuple[int | None, int | None], tip: np.ndarray
    ) -> None:
        particle, body = held
        loop.hold(
            0, particle=particle, body=body, tip=tip[:3], rotation=quat_from_yaw(float(tip[3]))
        )
