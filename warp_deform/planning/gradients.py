"""Gradients of the task's loss with respect to where an action places, by the solver's adjoint.

A heap of beads is chaotic: the exact derivative of where it ends is large and points nowhere. Where
a task says so (`Task.gradient_damping`), the rollout that is differentiated is damped more than the
one that counts, and its derivative agrees with what 5 mm do to the latter.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..rollout.differentiable import DifferentiableRollout, Gradients
from ..rollout.rollouts import GripPath
from ..tasks.task import Action, Task
from ..worlds.episode import Carry, RunningEpisode
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds
from .follow import Follow

__all__ = [
    "ActionGradients",
    "KnotGradient",
    "PlaceGradient",
    "gradients_for",
    "loss_and_gradients",
]

LANES = 8
PLACE = slice(3, 7)
"""Of an action, what gradients are with respect to: place x, y [m], yaw [rad], lift [m]."""
SETTLE = 0.3
"""How long a world runs on after the longest path, before the loss is taken [s]."""
_MEMORY = 2**29  # bytes
_STEP = 1e-5  # of the finite differences of a path by its action, which is smooth [m], [rad]


@dataclass(frozen=True, eq=False)
class PlaceGradient:
    """Loss of the task after an action, and its derivatives by place x, y [1/m], yaw [1/rad] and by
    the lift [1/m], at which the tip goes on with the speeds of the same stage.

    Attributes:
        usable: whether the tip took something and every derivative is a number
        growth: largest derivative by a position at the start over the largest by one at the end, of
            particles and bodies; large where the rollout is chaotic
    """

    loss: float
    by_place: np.ndarray
    growth: float
    usable: bool


@dataclass(frozen=True, eq=False)
class KnotGradient:
    """The same by the knots of a path that was given: (K, 3) [1/m] and (K,) [1/s]."""

    loss: float
    by_points: np.ndarray
    by_times: np.ndarray
    growth: float
    usable: bool


_NONE = PlaceGradient(np.inf, np.zeros(4), np.inf, False)


@dataclass(frozen=True, eq=False)
class _Ends:
    """Derivatives (W, P, 3), (W, B, 7) by the particles and the bodies' frames at an end."""

    particles: np.ndarray
    bodies: np.ndarray

    def most(self) -> np.ndarray:
        """Largest by a position (W,)."""
        return _most(self.particles, self.bodies)


@dataclass(frozen=True, eq=False)
class _Leg:
    """One differentiated action of some slots.

    Attributes:
        particles: where it ends (W, P, 3) [m]
        bodies: likewise (W, B, 7)
    """

    slots: list[int]
    carries: dict[int, Carry]
    actions: dict[int, Action]
    paths: dict[int, GripPath]
    particles: np.ndarray
    bodies: np.ndarray


class ActionGradients:
    """Worlds in which actions are differentiated, `LANES` at a time; `rollouts` counts them."""

    def __init__(self, task: Task, *, robot: str, precision: str) -> None:
        self._worlds = Worlds(task, LANES, robot=robot, lanes=LANES, precision=precision)
        # what sleeps does not answer to a small change
        self._run = DifferentiableRollout(self._worlds.solver, memory=_MEMORY, sleep=False)
        self.rollouts = 0

    def of(self, jobs: Sequence[tuple[WorldState, Action]]) -> list[PlaceGradient]:
        """The gradient of every action from its state, in the order given."""
        of_jobs: list[PlaceGradient] = []
        for first in range(0, len(jobs), LANES):
            of_jobs += self._of_lanes(jobs[first : first + LANES])
        self.rollouts += len(jobs)
        return of_jobs

    def of_pairs(
        self, jobs: Sequence[tuple[WorldState, Action, Follow]]
    ) -> list[tuple[PlaceGradient, PlaceGradient]]:
        """Gradients of the loss after two actions by the place of the first and of the second.

        The second picks what it follows where the first leaves it. Its loss is that of the task
        before the first. Speeds that the first leaves do not count: they die before the second.
        """
        of_jobs: list[tuple[PlaceGradient, PlaceGradient]] = []
        for first in range(0, len(jobs), LANES):
            of_jobs += self._of_pair_lanes(jobs[first : first + LANES])
        self.rollouts += 2 * len(jobs)
        return of_jobs

    def by_knots(
        self, jobs: Mapping[int, tuple[WorldState, Action]], paths: Mapping[int, GripPath]
    ) -> dict[int, KnotGradient]:
        """Gradients of up to `LANES` actions that take other paths than their own, by slot.

        Slots whose tip takes nothing are left out.
        """
        leg = self._leg(jobs, paths)
        if leg is None:
            return {}
        self.rollouts += len(leg.slots)
        losses, ends = self._losses(leg, {slot: state.episode for slot, (state, _) in jobs.items()})
        gradients = self._backward(ends)
        growth = _growth(gradients, ends)
        of_slots = {}
        for k, slot in enumerate(leg.slots):
            by = gradients.waypoints[slot], gradients.knot_times[slot]
            usable = bool(np.isfinite(losses[k]) and all(np.isfinite(part).all() for part in by))
            of_slots[slot] = KnotGradient(losses[k], *by, float(growth[k]), usable)
        return of_slots

    def _of_lanes(self, jobs: Sequence[tuple[WorldState, Action]]) -> list[PlaceGradient]:
        of_jobs = [_NONE] * len(jobs)
        leg = self._leg(dict(enumerate(jobs)))
        if leg is not None:
            before = {slot: state.episode for slot, (state, _) in enumerate(jobs)}
            losses, ends = self._losses(leg, before)
            gradients = self._backward(ends)
            growth = _growth(gradients, ends)
            for k, slot in enumerate(leg.slots):
                of_jobs[slot] = _place_gradient(leg, k, losses[k], gradients, float(growth[k]))
        return of_jobs

    def _of_pair_lanes(
        self, jobs: Sequence[tuple[WorldState, Action, Follow]]
    ) -> list[tuple[PlaceGradient, PlaceGradient]]:
        worlds, of_jobs = self._worlds, [(_NONE, _NONE)] * len(jobs)
        firsts = {slot: (state, action) for slot, (state, action, _) in enumerate(jobs)}
        leg = self._leg(firsts)
        if leg is None:
            return of_jobs
        between = {slot: worlds.state(slot) for slot in leg.slots}
        for slot, state in between.items():
            worlds.restore(slot, state)  # which looks at where the first ended
        follows = {slot: jobs[slot][2] for slot in leg.slots}
        snapshots = {slot: worlds.episodes[slot].snapshot for slot in leg.slots}
        seconds = {
            slot: (between[slot], follow.action(snapshots[slot]))
            for slot, follow in follows.items()
        }
        second = self._leg(seconds)
        if second is None:
            return of_jobs
        losses, ends = self._losses(second, {slot: firsts[slot][0].episode for slot in firsts})
        after = self._backward(ends)
        growth = _growth(after, ends)
        of_seconds = [
            _place_gradient(second, k, losses[k], after, float(growth[k]))
            for k in range(len(losses))
        ]
        particles, bodies = np.zeros_like(leg.particles), np.zeros_like(leg.bodies)
        for k, slot in enumerate(second.slots):
            at = leg.slots.index(slot)
            particles[at], bodies[at] = after.positions[k], after.body_poses[k]
            pick = _chained(second, slot, after, range(2))
            follows[slot].add(
                pick, _by_turn(second, slot, after), snapshots[slot], particles[at], bodies[at]
            )
        again = self._leg(firsts)  # the tape holds one rollout, and that was the second
        assert again is not None and again.slots == leg.slots
        gradients = self._backward(_Ends(particles, bodies))
        whole = _most(gradients.positions, gradients.body_poses)
        for k, slot in enumerate(second.slots):
            at = leg.slots.index(slot)
            most = float(ends.most()[k])
            grown = float(whole[at]) / most if most > 0 else np.inf
            first = _place_gradient(leg, at, losses[k], gradients, grown)
            of_jobs[slot] = first, of_seconds[k]
        return of_jobs

    def _leg(
        self,
        jobs: Mapping[int, tuple[WorldState, Action]],
        paths: Mapping[int, GripPath] | None = None,
    ) -> _Leg | None:
        """Run actions with the tape on, those whose tip takes something; None: none does."""
        worlds = self._worlds
        damping = worlds.task.gradient_damping
        for slot, (state, _) in jobs.items():
            worlds.restore(slot, state)
            if damping is not None:  # instead of what an episode's own physics says
                worlds.solver.set_world(slot, damping=damping)
        actions = {slot: action for slot, (_, action) in jobs.items()}
        carries = worlds.lead(actions)
        slots = sorted(carries)
        if not slots:
            return None
        if paths is None:
            paths = {slot: carries[slot](actions[slot])[1] for slot in slots}
        paths = {slot: paths[slot] for slot in slots}
        end = max(float(path.times[-1]) for path in paths.values()) + SETTLE
        particles = self._run.forward(slots, [end], paths=paths)[:, 0]
        return _Leg(slots, carries, actions, paths, particles, self._run.body_poses[:, 0])

    def _losses(self, leg: _Leg, before: Mapping[int, RunningEpisode]) -> tuple[list[float], _Ends]:
        """The task's loss where each slot ends, and its derivatives."""
        each_end = [
            loss_and_gradients(self._worlds.task, before[slot], particles, bodies)
            for slot, particles, bodies in zip(leg.slots, leg.particles, leg.bodies, strict=True)
        ]
        losses, by_particles, by_bodies = zip(*each_end, strict=True)
        return list(losses), _Ends(np.stack(by_particles), np.stack(by_bodies))

    def _backward(self, ends: _Ends) -> Gradients:
        return self._run.backward(ends.particles[:, None], bodies=ends.bodies[:, None])


def loss_and_gradients(
    task: Task, episode: RunningEpisode, particle_q: np.ndarray, body_q: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """The task's loss of an end state, and its derivatives (P, 3) by particles, (B, 7) by bodies.

    Args:
        episode: before the action
    """
    import torch

    ends = [
        torch.tensor(np.asarray(array), dtype=torch.float64, requires_grad=True)
        for array in (particle_q, body_q)
    ]
    value = task.loss(episode.layout, episode.snapshot, *ends)
    gradients = torch.autograd.grad(value, ends, allow_unused=True, materialize_grads=True)
    return value.item(), gradients[0].numpy(), gradients[1].numpy()


def _place_gradient(
    leg: _Leg, k: int, loss: float, gradients: Gradients, growth: float
) -> PlaceGradient:
    """Of the k-th slot of a leg."""
    by_place = _chained(leg, leg.slots[k], gradients, range(PLACE.start, PLACE.stop))
    usable = bool(np.isfinite(by_place).all() and np.isfinite(loss))
    return PlaceGradient(loss, by_place, growth, usable)


def _growth(gradients: Gradients, ends: _Ends) -> np.ndarray:
    """Largest derivative by a position at the start over the largest at the end (W,)."""
    start, end = _most(gradients.positions, gradients.body_poses), ends.most()
    return np.divide(start, end, out=np.full_like(start, np.inf), where=end > 0)


def _most(particles: np.ndarray, bodies: np.ndarray) -> np.ndarray:
    """Largest derivative by a position (W,) of particles (W, P, 3) and bodies (W, B, 7)."""
    both = np.concatenate([particles, bodies[..., :3]], axis=1)
    return np.asarray(np.abs(both).max(axis=(1, 2)))


def _chained(leg: _Leg, slot: int, gradients: Gradients, numbers: Sequence[int]) -> np.ndarray:
    """Chain derivatives by the knots of a slot's path back to some numbers of its action."""
    carried, action, out = leg.carries[slot], leg.actions[slot], []
    by_points, by_times = gradients.waypoints[slot], gradients.knot_times[slot]
    for at in numbers:
        ends = []
        for sign in (1, -1):
            moved = action.copy()
            moved[at] += sign * _STEP
            ends.append(carried(moved)[1])
        if not len(ends[0].times) == len(ends[1].times) == len(by_times):
            return np.full(len(numbers), np.nan)  # the path is about to get another knot
        change = (by_points * (ends[0].positions - ends[1].positions)).sum()
        change += (by_times * (ends[0].times - ends[1].times)).sum()
        if ends[0].rotations is not None and ends[1].rotations is not None:
            turned = ends[0].rotations - ends[1].rotations
            change += (gradients.knot_rotations[slot] * turned).sum()
        out.append(float(change) / (2 * _STEP))
    return np.array(out)


def _by_turn(leg: _Leg, slot: int, gradients: Gradients) -> float:
    """Derivative by a turn about the vertical of what is held in the tip, all along the path."""
    x, y, z, w = np.asarray(leg.paths[slot].rotations).T
    return float((gradients.knot_rotations[slot] * np.stack([y, -x, w, -z], axis=1)).sum() / 2)


@functools.lru_cache(maxsize=2)
def gradients_for(task: Task, robot: str, precision: str) -> ActionGradients:
    """This process's worlds to differentiate actions in, built once and used again."""
    return ActionGradients(task, robot=robot, precision=precision)
