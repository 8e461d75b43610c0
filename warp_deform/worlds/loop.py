"""The episode loop: keep every world busy until all seeds have been played.

One loop serves demonstrations, evaluation and replay; they differ in who acts and what is kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from ..episodes import Goal
from ..errors import InputError, WarpDeformError
from ..tasks.registry import task as find_task
from ..tasks.task import Task
from .episode import DEMONSTRATOR_STREAM, episode_rng
from .worlds import Worlds

__all__ = ["SLOTS", "SOLVED", "Act", "EpisodeRun", "play", "reset_each", "worlds_for"]

Row = TypeVar("Row")

SLOTS = 8
"""Episodes that run side by side in one process: one group of SIMD lanes."""
SOLVED = "solved"
"""What `EpisodeRun.ended` says of an episode that reached its task's success."""


@dataclass(eq=False)
class EpisodeRun(Generic[Row]):
    """One episode as it goes.

    Attributes:
        rows: what `look` returned at the start and after every action
        actions: (7,) each
        outcomes: what became of them
        ended: why the episode is over, None while it runs
    """

    seed: int
    rng: np.random.Generator
    rows: list[Row] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    outcomes: list[str] = field(default_factory=list)
    ended: str | None = None


Act = Callable[[Worlds, Mapping[int, EpisodeRun[Row]]], Mapping[int, np.ndarray | None]]
"""Next action (7,) of every running slot, or None for a slot whose episode is to end."""


def worlds_for(task: str, robot: str) -> Worlds:
    """This process's `SLOTS` worlds of a task, built once and used again.

    Their number changes no bit; the same one for every use means one kernel to compile. A class
    that was registered anew under the name gets worlds of its own.
    """
    return _worlds(type(find_task(task)), robot)


@functools.lru_cache(maxsize=2)
def _worlds(task: type[Task], robot: str) -> Worlds:
    return Worlds(task(), SLOTS, robot=robot, lanes=SLOTS)


def play(
    worlds: Worlds,
    seeds: Iterable[int],
    *,
    act: Act[Row],
    look: Callable[[Worlds, int], Row],
    goals: Callable[[int], Goal | None] | None = None,
    until_solved: bool = True,
) -> Iterator[tuple[int, EpisodeRun[Row]]]:
    """Play the episodes of `seeds` and yield each, with its slot, the moment it is over.

    A slot whose episode is over gets the next seed, so lanes stay full; the slot still shows the
    yielded episode until the iteration goes on. Neither the order of seeds nor the number of slots
    changes an episode.

    Args:
        look: called with a slot at the start and after every action of an episode whose physics
            holds
        goals: the goal of a seed, None to construct it
        until_solved: end episodes that are solved, over by their task's rules (`Task.ended`), or
            have used up their actions; else `act` alone ends them
    """
    waiting = iter(seeds)
    free = list(range(worlds.count))
    running: dict[int, EpisodeRun[Row]] = {}
    while True:
        # zip asks `free` first, so no seed is lost when the slots run out
        new = {
            slot: EpisodeRun[Row](seed, episode_rng(seed, DEMONSTRATOR_STREAM))
            for slot, seed in zip(free, waiting, strict=False)
        }
        free = free[len(new) :]
        _start(worlds, new, goals)
        running |= new
        if not running:
            return
        for slot, run in new.items():
            if run.ended is None:
                _see(worlds, slot, run, look, until_solved)
        live = {slot: run for slot, run in running.items() if run.ended is None}
        actions = act(worlds, live)
        for slot, run in live.items():
            if actions[slot] is None:
                run.ended = "nothing to do"
        chosen = {slot: a for slot in live if (a := actions[slot]) is not None}
        reports = worlds.step(chosen) if chosen else {}
        for slot, report in reports.items():
            run = running[slot]
            run.actions.append(np.array(chosen[slot], dtype=float))
            run.outcomes.append(report.outcome.value)
            _see(worlds, slot, run, look, until_solved)
        for slot in [slot for slot, run in running.items() if run.ended is not None]:
            free.append(slot)
            yield slot, running.pop(slot)


def _start(
    worlds: Worlds,
    new: Mapping[int, EpisodeRun[Row]],
    goals: Callable[[int], Goal | None] | None,
) -> None:
    """Reset the slots of `new`, with the goals of their seeds."""

    def reset(seeds: Mapping[int, int]) -> None:
        given = {slot: goal for slot, seed in seeds.items() if goals and (goal := goals(seed))}
        worlds.reset(seeds, goals=given)

    reset_each(new, reset)


class Startable(Protocol):
    """An episode of a seed, which may end before it has begun."""

    seed: int
    ended: str | None


def reset_each(new: Mapping[int, Startable], reset: Callable[[Mapping[int, int]], object]) -> None:
    """Reset slots together; a seed without a valid start ends its own episode alone.

    Args:
        new: episodes by slot; where one has no start, its `ended` says why
        reset: resets slots by their seeds
    """
    if not new:
        return
    try:
        reset({slot: run.seed for slot, run in new.items()})
    except InputError:
        raise
    except WarpDeformError as error:
        if len(new) == 1:
            next(iter(new.values())).ended = str(error)
            return
        for slot, run in new.items():
            reset_each({slot: run}, reset)


def _see(
    worlds: Worlds,
    slot: int,
    run: EpisodeRun[Row],
    look: Callable[[Worlds, int], Row],
    until_solved: bool,
) -> None:
    """Take a row and find out whether the episode is over."""
    episode = worlds.episodes[slot]
    if not episode.physics_ok:
        # such a state may not be finite, so nothing looks at it
        run.ended = "physics: " + "; ".join(map(str, episode.problems))
        return
    run.rows.append(look(worlds, slot))
    if until_solved and worlds.solved(slot):
        run.ended = SOLVED
    elif until_solved and episode.ended:
        run.ended = f"over without success after {len(episode.history)} actions"
    elif until_solved and len(episode.history) >= worlds.task.max_actions:
        run.ended = f"not solved in {len(episode.history)} actions"
