"""Gradient descent on the places of two consecutive actions at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..tasks.task import Task
from ..worlds.state import WorldState
from .descent import Descent
from .follow import Follow
from .lookahead import Lookahead, Outlook
from .places import Places

__all__ = ["JOINT_COST", "Pair", "move_both"]

Pair = tuple[Outlook, Outlook]
"""What two actions lead to, one after the other; the first one's state is kept."""
JOINT_COST = 11
"""Rollouts that a step counts as: two taped ones with their repetitions, and two to try it."""


def move_both(
    lookahead: Lookahead,
    task: Task,
    state: WorldState,
    pairs: Sequence[Pair],
    places: Places,
    *,
    steps: int,
    scale: np.ndarray,
) -> list[Pair]:
    """Pairs tried as they would run, after each of `steps` steps from each of `pairs`.

    A pair whose gradient cannot be used stops there.

    Args:
        scale: (4,), lengths of the first step by place x, y [m], yaw [rad], lift [m]
    """
    moving: list[tuple[np.ndarray, Follow, Pair]] = []
    for pair in pairs:
        first, second = pair
        assert first.after is not None
        follow = Follow.of(task, first.after.episode.snapshot, second.action)
        if follow is not None:
            moving.append((first.action, follow, pair))
    descent = Descent((len(moving), 8), np.tile(scale, 2))
    tries: list[tuple[np.ndarray, Follow]] = []
    stuck = [False] * len(moving)
    for _ in range(steps):
        of_pairs = lookahead.gradients().of_pairs([(state, first, f) for first, f, _ in moving])
        lookahead.rollouts += (JOINT_COST - 2) * len(of_pairs)
        gradients = np.zeros((len(moving), 8))
        for i, (action, follow, _) in enumerate(moving):
            by_first = places.gradient(of_pairs[i][0], action)
            by_second = places.gradient(of_pairs[i][1], follow.like)
            if by_first is None or by_second is None:
                stuck[i] = True
            else:
                gradients[i] = np.concatenate([by_first, by_second])
        changes = descent.step(gradients)
        for i, (action, follow, pair) in enumerate(moving):
            if stuck[i]:
                continue
            moved = places.moved(action, changes[i, :4], pair[0].action)
            like = places.moved(follow.like, changes[i, 4:], pair[1].action)
            moving[i] = moved, replace(follow, like=like), pair
            tries.append(moving[i][:2])
    firsts = lookahead.try_each([(state, action) for action, _ in tries], keep=True)
    followed = [(f, o) for (_, f), o in zip(tries, firsts, strict=True) if o.after and o.goes_on]
    jobs = [(o.after, f.action(o.after.episode.snapshot)) for f, o in followed if o.after]
    seconds = lookahead.try_each(jobs)
    return [
        (replace(o, origin="gradient"), replace(second, origin="gradient"))
        for (_, o), second in zip(followed, seconds, strict=True)
    ]
