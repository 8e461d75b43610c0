"""The demonstrators by name: who acts while episodes are collected.

`scripted` is the task's own; `visible` picks only what the tip would really meet; `mpc` (model
predictive control, over a horizon of one action) simulates the task's candidates, each from a copy
of the present state, and takes the most promising. All three see the simulator's state.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .episode_loop import SLOTS, Act, Run
from .errors import InputError, WarpDeformError
from .robots.primitive import Outcome
from .spaces import action_space
from .tasks.task import Action, Task
from .worlds import Worlds

__all__ = ["DEMONSTRATORS", "demonstrator"]

CANDIDATES = 8
"""Candidates an episode and action: one group of SIMD lanes."""
LOOKAHEAD_REST = 1.0
"""Longest wait for rest after a candidate [s]; one that still moves is judged as it is."""


def demonstrator(name: str) -> Act[Any]:
    """Who acts in `episode_loop.play`: the demonstrator called `name`.

    What it does in an episode depends on the episode alone: its state and its generator.

    Raises:
        InputError: there is none.
    """
    if name not in DEMONSTRATORS:
        known = ", ".join(DEMONSTRATORS)
        raise InputError(f"there is no demonstrator {name!r}; there are: {known}")
    return DEMONSTRATORS[name]


def _scripted(worlds: Worlds, runs: Mapping[int, Run[Any]]) -> dict[int, Action | None]:
    """What the task's scripted demonstrator does next, in every slot."""
    return _each(worlds, runs, worlds.task.demonstrate)


def _visible(worlds: Worlds, runs: Mapping[int, Run[Any]]) -> dict[int, Action | None]:
    """What the task's visible demonstrator does next, in every slot."""
    return _each(worlds, runs, worlds.task.demonstrate_visible)


def _each(
    worlds: Worlds, runs: Mapping[int, Run[Any]], choose: Callable[..., Action | None]
) -> dict[int, Action | None]:
    episodes = worlds.episodes
    return {
        slot: choose(episodes[slot].layout, episodes[slot].snapshot, run.rng)
        for slot, run in runs.items()
    }


class _Job(NamedTuple):
    """A candidate of a slot."""

    slot: int
    action: Action


def _mpc(worlds: Worlds, runs: Mapping[int, Run[Any]]) -> dict[int, Action | None]:
    """The candidate with the best outcome in every slot; of equals the one proposed first."""
    chosen: dict[int, Action | None] = dict.fromkeys(runs)
    jobs = []
    for slot, run in runs.items():
        actions = _candidates(worlds, slot, run)
        if len(actions) == 1:
            chosen[slot] = actions[0]  # nothing to choose from
        else:
            jobs += [_Job(slot, action) for action in actions]
    ranks = _outcomes(worlds, jobs)
    best: dict[int, tuple[int, float]] = {}
    for job, rank in zip(jobs, ranks, strict=True):
        if job.slot not in best or rank > best[job.slot]:
            best[job.slot], chosen[job.slot] = rank, job.action
    return chosen


def _candidates(worlds: Worlds, slot: int, run: Run[Any]) -> list[Action]:
    """Different candidates of the task that the environments allow, at most `CANDIDATES`."""
    episode = worlds.episodes[slot]
    proposed = worlds.task.candidates(episode.layout, episode.snapshot, run.rng, CANDIDATES)
    different = {action.tobytes(): action for action in proposed}
    return [action for action in different.values() if action_space().contains(action)][:CANDIDATES]


def _outcomes(worlds: Worlds, jobs: Sequence[_Job]) -> list[tuple[int, float]]:
    """How good the outcome of every job is; greater is better."""
    if not jobs:
        return []
    count = CANDIDATES * min(worlds.count, SLOTS)
    lookahead = _lookahead(worlds.task, worlds.robot.name, worlds.precision, count)
    states = {slot: worlds.state(slot) for slot in {job.slot for job in jobs}}
    ranks: dict[int, tuple[int, float]] = {}
    # lanes wait for the slowest among them, so those that carry equally far go together
    order = sorted(range(len(jobs)), key=lambda i: _distance(jobs[i].action))
    for first in range(0, len(order), count):
        part = dict(enumerate(order[first : first + count]))
        for at, i in part.items():
            lookahead.restore(at, states[jobs[i].slot])
        reports = lookahead.step({at: jobs[i].action for at, i in part.items()})
        ranks |= {i: _rank(lookahead, at, reports[at].outcome) for at, i in part.items()}
    return [ranks[i] for i in range(len(jobs))]


@functools.lru_cache(maxsize=2)
def _lookahead(task: Task, robot: str, precision: str, count: int) -> Worlds:
    """Worlds to try candidates in, built once and used again."""
    return Worlds(
        task, count, robot=robot, lanes=CANDIDATES, precision=precision, rest_limit=LOOKAHEAD_REST
    )


def _rank(worlds: Worlds, slot: int, outcome: Outcome) -> tuple[int, float]:
    """Solved before placed, before what moved nothing, before what cannot be trusted."""
    if outcome is Outcome.INVALID:
        return 0, 0.0
    episode = worlds.episodes[slot]
    promise = float(worlds.task.promise(episode.layout, episode.snapshot))
    if not math.isfinite(promise):
        raise WarpDeformError(f"{worlds.task.name}: the promise of a state is {promise}")
    if outcome is not Outcome.PLACED:
        return 1, promise
    return (3 if worlds.solved(slot) else 2), promise


def _distance(action: Action) -> float:
    """How far an action carries [m]."""
    return float(np.linalg.norm(action[3:5] - action[:2]))


DEMONSTRATORS: dict[str, Act[Any]] = {"scripted": _scripted, "visible": _visible, "mpc": _mpc}
"""The demonstrators by name."""
