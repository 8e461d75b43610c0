"""Why an episode failed, by simple rules on what its actions did.

The first rule that holds names the failure:

physics               a guard of the solver fired, so the state cannot be trusted
missed grasp          at least half of the actions took nothing: missed, or out of reach
destructive bag action  an action, not a carry, closed the opening by a quarter of its full size or
                      more, and it did not come back
item not enclosed     an item was inserted or the bag carried, and an item ended outside of the bag
opening covered       at the end at most a third of the bag's beads can be seen, which is where the
                      demonstrator gives up too
back and forth        at least twice an action put back, within 3 cm, what the one before had moved
other                 none of these

Source: the failures that Seita et al., ICRA 2021, describe in their sections on bags and on
physical experiments; the rules and their numbers are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.bag_opening import BagTask
from warp_deform.tasks.bag_physics import CARRY, OPEN
from warp_deform.worlds.loop import SOLVED, EpisodeRun
from warp_deform.worlds.worlds import Worlds

__all__ = [
    "bag_holds_items",
    "bag_opening",
    "closed",
    "failure",
    "puts_back",
    "took_nothing",
]

_CLOSED = 0.25
_NEAR = 0.03


def bag_opening(worlds: Worlds, slot: int) -> float | None:
    """How far the (first) bag of a slot is open, of its full opening; None without a bag."""
    task = worlds.task
    return task.opening(worlds.episodes[slot].snapshot) if isinstance(task, BagTask) else None


def bag_holds_items(worlds: Worlds, slot: int) -> bool | None:
    """Whether every item of a slot is in its (first) bag; None without a bag or items.

    How they came there does not count, other than for `Task.enclosed`.
    """
    task, snapshot = worlds.task, worlds.episodes[slot].snapshot
    if not isinstance(task, BagTask) or not len(snapshot.body_q):
        return None
    return all(task.inside_bag(snapshot, body) for body in range(len(snapshot.body_q)))


def failure(
    worlds: Worlds, slot: int, run: EpisodeRun[Any], openings: Sequence[float | None]
) -> str | None:
    """Which of `FAILURES` an episode is that has just ended in a slot; None if it was solved.

    Args:
        openings: what `bag_opening` said at the start and after every action
    """
    if run.ended == SOLVED:
        return None
    episode, task = worlds.episodes[slot], worlds.task
    if not episode.physics_ok:
        return "physics"
    if took_nothing(run.outcomes):
        return "missed grasp"
    if isinstance(task, BagTask) and run.actions:
        stages = [task.stage_of(float(action[6])) for action in run.actions]
        opened = [0.0 if each is None else each for each in openings]
        if closed(opened, [stage is not CARRY for stage in stages]):
            return "destructive bag action"
        tried = any(stage is not OPEN for stage in stages)
        if tried and bag_holds_items(worlds, slot) is False:
            return "item not enclosed"
        if task.hidden(episode.layout, episode.snapshot):
            return "opening covered"
    return "back and forth" if puts_back(run.actions) else "other"


def took_nothing(outcomes: Sequence[str]) -> bool:
    """Whether at least half of the actions took nothing."""
    nothing = sum(each in (Outcome.MISSED, Outcome.UNREACHABLE) for each in outcomes)
    return bool(outcomes) and 2 * nothing >= len(outcomes)


def closed(openings: Sequence[float], counts: Sequence[bool]) -> bool:
    """Whether an action that counts closed the opening for the rest of the episode.

    Args:
        openings: shares of the full opening (T + 1,)
        counts: whether each action counts (T,); False for a carry, which closes any bag
    """
    return any(
        counted and openings[t] - max(openings[t + 1 :]) >= _CLOSED
        for t, counted in enumerate(counts)
        if openings[t + 1 :]
    )


def puts_back(actions: Sequence[np.ndarray]) -> bool:
    """Whether at least two actions (7,) took what the one before had placed back to its pick."""
    ends = [(action[0:2], action[3:5]) for action in actions]
    undone = [
        np.hypot(*(pick - placed)) < _NEAR and np.hypot(*(place - picked)) < _NEAR
        for (picked, placed), (pick, place) in pairwise(ends)
    ]
    return sum(map(bool, undone)) >= 2
