"""The way between pick and place moved downhill: paths that the action's seven numbers cannot say.

The straight carry of an action becomes a chain of waypoints, which Adam moves together with the
place by the adjoint of the solver. The tip goes along it as fast as it went along the straight
line. Every iterate is run as it is, and the best is kept; the straight line is the first. Where a
gradient cannot be used, the next iterate is drawn around the best so far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..rendering.pixels import BOUNDS
from ..robots.primitive import LIFT, Motion, solve_joints
from ..rollout.rollouts import GripPath
from ..support.quaternion import quat_from_yaw
from ..tasks.task import Action, Task
from ..worlds.episode import Carry, Execution
from ..worlds.state import WorldState
from ..worlds.tip_step import carry_and_release
from ..worlds.worlds import Worlds
from .descent import Descent
from .gradients import LANES, gradients_for, loss_and_gradients
from .places import MOST_GROWTH

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["BentPath", "PathResult", "WaypointConfig", "Waypoints"]

_LOW, _HIGH = np.array(BOUNDS[:2]).T


@dataclass(frozen=True, kw_only=True)
class WaypointConfig:
    """How waypoints are moved."""

    points: int = 6
    """Way-points between the lift and the descent."""
    steps: int = 12
    """Steps downhill; each is a differentiated rollout and one that counts."""
    rate: float = 0.01
    """Length of the first step of every coordinate [m]."""

    def __post_init__(self) -> None:
        if min(self.points, self.steps) < 1 or not self.rate > 0:
            raise InputError(
                "waypoints need at least one point, at least one step, and a rate above 0"
            )


@dataclass(frozen=True)
class PathResult:
    """What a path led to: the task's loss and score, and the state's hash."""

    loss: float
    score: float
    state_hash: str


@dataclass(frozen=True, eq=False)
class BentPath:
    """An action's straight path and the best one found.

    Attributes:
        path: the best; None where the straight one stayed the best, or there is none
        before: None where the tip takes nothing, the arm does not reach, or the place is the pick
        steps: how many had a gradient that could be used, the others were drawn
        growth: largest of the gradients that were used
    """

    path: GripPath | None
    before: PathResult | None
    after: PathResult | None
    steps: int
    growth: float


class Waypoints:
    """Worlds in which the paths of up to `LANES` actions are bent at once.

    rest_limit: see `Worlds`
    """

    def __init__(self, task: Task, *, robot: str, precision: str = "float32") -> None:
        self._worlds = Worlds(task, LANES, robot=robot, lanes=LANES, precision=precision)
        self._gradients = gradients_for(task, robot, precision)

    def bend(
        self, jobs: Sequence[tuple[WorldState, Action]], config: WaypointConfig
    ) -> list[BentPath]:
        """The best path found for each action from its state, in the order given.

        Depends on state and action alone.
        """
        bent: list[BentPath] = []
        for first in range(0, len(jobs), LANES):
            bent += self._bend_lanes(jobs[first : first + LANES], config)
        return bent

    def run(
        self, jobs: dict[int, tuple[WorldState, Action]], paths: dict[int, GripPath]
    ) -> dict[int, PathResult]:
        """Run a path of each slot instead of its action's, as an action is run.

        Slots are left out where the tip takes nothing, the arm cannot follow, or the state cannot
        be trusted.
        """
        worlds = self._worlds
        carries = self._lead(jobs)
        moving = self._followed(jobs, paths)
        if not moving:
            return {}
        runs = carry_and_release(worlds, {slot: paths[slot] for slot in moving})
        ran: dict[int, PathResult] = {}
        for slot in moving:
            episode = worlds.episodes[slot]
            episode.problems += runs[slot].watch.problems(slot, worlds.solver.config.limits)
            if not episode.physics_ok:
                continue
            execution = Execution(jobs[slot][1])
            execution.placed(runs[slot], carries[slot], paths[slot])
            episode.history += (execution.past(execution.outcome),)
            worlds.restore(slot, worlds.state(slot))  # which looks at where it ended
            end = worlds.episodes[slot].snapshot
            before = jobs[slot][0].episode
            loss, _, _ = loss_and_gradients(worlds.task, before, end.particle_q, end.body_q)
            ran[slot] = PathResult(loss, float(worlds.score(slot)), worlds.hash(slot))
        return ran

    def _bend_lanes(
        self, jobs: Sequence[tuple[WorldState, Action]], config: WaypointConfig
    ) -> list[BentPath]:
        by_slot = dict(enumerate(jobs))
        carries = self._lead(by_slot)
        straight = {slot: carried(by_slot[slot][1])[1] for slot, carried in carries.items()}
        bends = {
            slot: bend
            for slot, path in straight.items()
            if (bend := _Bend.of(path, float(by_slot[slot][1][6]), config.points)) is not None
        }
        by_slot = {slot: by_slot[slot] for slot in bends}
        before = self.run(by_slot, {slot: straight[slot] for slot in by_slot})
        best: dict[int, tuple[PathResult, GripPath | None]] = {
            s: (ran, None) for s, ran in before.items()
        }
        slots = sorted(best)
        values = np.array([bends[slot].start for slot in slots]).reshape(len(slots), -1)
        descent = Descent(values.shape, np.full(values.shape[1], config.rate))
        rngs = [np.random.default_rng(0) for _ in slots]  # of each its own: neighbours do not count
        best_values = values.copy()
        used, growth = dict.fromkeys(slots, 0), dict.fromkeys(slots, 0.0)
        for _ in range(config.steps if slots else 0):
            paths = {slot: bends[slot].path(values[k]) for k, slot in enumerate(slots)}
            of_slots = self._gradients.by_knots({slot: by_slot[slot] for slot in slots}, paths)
            by_value, drawn = np.zeros_like(values), set[int]()
            for k, slot in enumerate(slots):
                gradient = of_slots.get(slot)
                if gradient is None or not gradient.usable or gradient.growth > MOST_GROWTH:
                    drawn.add(k)
                    continue
                used[slot] += 1
                growth[slot] = max(growth[slot], gradient.growth)
                by_value[k] = bends[slot].chained(values[k], gradient.by_points, gradient.by_times)
            change = descent.step(by_value)
            for k, slot in enumerate(slots):
                near = best_values[k] + rngs[k].normal(0.0, config.rate, values.shape[1])
                values[k] = bends[slot].limited(near if k in drawn else values[k] + change[k])
            tries = {slot: bends[slot].path(values[k]) for k, slot in enumerate(slots)}
            for slot, ran in self.run({slot: by_slot[slot] for slot in slots}, tries).items():
                if ran.loss < best[slot][0].loss:
                    best[slot] = ran, tries[slot]
                    best_values[slots.index(slot)] = values[slots.index(slot)]
        return [
            BentPath(best[s][1], before[s], best[s][0], used[s], growth[s])
            if s in best
            else BentPath(None, None, None, 0, 0.0)
            for s in range(len(jobs))
        ]

    def _lead(self, jobs: dict[int, tuple[WorldState, Action]]) -> dict[int, Carry]:
        """Lead the tips down; how those that have taken something would carry it."""
        for slot, (state, _) in jobs.items():
            self._worlds.restore(slot, state)
        return self._worlds.lead({slot: action for slot, (_, action) in jobs.items()})

    def _followed(
        self, jobs: dict[int, tuple[WorldState, Action]], paths: dict[int, GripPath]
    ) -> list[int]:
        """Slots whose arm can follow the path."""
        motions = {}
        for slot, path in paths.items():
            assert path.rotations is not None
            yaws = 2 * np.arctan2(path.rotations[:, 2], path.rotations[:, 3])
            points = np.column_stack([path.positions, np.unwrap(yaws)])
            motions[slot] = Motion(np.asarray(path.times), points)
        postures = [self._worlds.episodes[slot].posture for slot in motions]
        joints = solve_joints(self._worlds.robot, list(motions.values()), postures)
        return [slot for slot, q in zip(motions, joints, strict=True) if q is not None]


@dataclass(frozen=True, eq=False)
class _Bend:
    """How numbers make a path: waypoints (n, 3) of the carry [m], then the place's shift (2,) [m].

    Attributes:
        base: the straight path
        first: its knot where the carry begins
        last: its knot where the carry ends
        start: the numbers (3 n + 2,) of the straight path
    """

    base: GripPath
    first: int
    last: int
    start: np.ndarray

    @staticmethod
    def of(base: GripPath, lift: float, points: int) -> _Bend | None:
        """None where the tip carries nowhere."""
        x = np.asarray(base.positions)
        (high,) = np.nonzero(np.abs(x[:, 2] - lift) < 1e-9)
        if len(high) < 2 or np.linalg.norm(x[high[-1]] - x[high[0]]) < 1e-3:
            return None
        # pauses repeat a knot: the carry begins with the last and ends with the first
        first = max(int(i) for i in high if (x[i] == x[high[0]]).all())
        last = min(int(i) for i in high if (x[i] == x[high[-1]]).all())
        share = np.arange(1, points + 1)[:, None] / (points + 1)
        way = x[first] + share * (x[last] - x[first])
        return _Bend(base, first, last, np.append(way.ravel(), [0.0, 0.0]))

    def path(self, values: np.ndarray) -> GripPath:
        """The path that the numbers make."""
        import torch

        positions, times = self._knots(torch.tensor(values))
        turns = np.asarray(self.base.rotations)
        yaws = np.unwrap(2 * np.arctan2(turns[:, 2], turns[:, 3]))
        share = np.linspace(0.0, 1.0, len(values) // 3 + 2)[1:-1]
        between = yaws[self.first] + share * (yaws[self.last] - yaws[self.first])
        yaws = np.concatenate([yaws[: self.first + 1], between, yaws[self.last :]])
        lower, late = self.base.lower, float(times[-1]) - float(self.base.times[-1])
        return replace(
            self.base,
            times=times.numpy(),
            positions=positions.numpy(),
            rotations=quat_from_yaw(yaws),
            lower=None if lower is None else (lower[0] + late, lower[1] + late),
        )

    def chained(
        self, values: np.ndarray, by_points: np.ndarray, by_times: np.ndarray
    ) -> np.ndarray:
        """Derivatives by the numbers, of those by the knots (K, 3), (K,)."""
        import torch

        x = torch.tensor(values, requires_grad=True)
        positions, times = self._knots(x)
        total = (positions * torch.tensor(by_points)).sum() + (times * torch.tensor(by_times)).sum()
        return np.asarray(torch.autograd.grad(total, x)[0].numpy())

    def limited(self, values: np.ndarray) -> np.ndarray:
        """Way-points above the table and not higher than a lift may be, the place on it."""
        inside, end = values.copy(), self.base.positions[-1]
        way = inside[:-2].reshape(-1, 3)  # a view
        way[:, :2] = np.clip(way[:, :2], _LOW, _HIGH)
        way[:, 2] = np.clip(way[:, 2], min(end[2], LIFT[0]), LIFT[1])
        inside[-2:] = np.clip(inside[-2:], _LOW - end[:2], _HIGH - end[:2])
        return inside

    def _knots(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (K, 3) and times (K,) of the path."""
        import torch

        base = torch.tensor(np.asarray(self.base.positions, dtype=float))
        clock = torch.tensor(np.asarray(self.base.times, dtype=float))
        shift = torch.cat([values[-2:], values.new_zeros(1)])
        after = base[self.last :] + shift
        way = torch.cat([base[self.first, None], values[:-2].reshape(-1, 3), after[:1]])
        straight = (base[self.last] - base[self.first]).norm()
        pace = (clock[self.last] - clock[self.first]) / straight
        lengths = ((way[1:] - way[:-1]).square().sum(1) + 1e-12).sqrt()
        along = clock[self.first] + pace * lengths.cumsum(0)
        positions = torch.cat([base[: self.first], way, after[1:]])
        late = along[-1] - clock[self.last]
        times = torch.cat([clock[: self.first + 1], along, clock[self.last + 1 :] + late])
        return positions, times
