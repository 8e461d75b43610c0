"""Starts that picks and places have made, before control begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import WarpDeformError
from ..worlds.episode import LAYOUT_STREAM, RunningEpisode
from ..worlds.worlds import Worlds
from .control_task import ControlTask

__all__ = ["disturb"]

_DRAWS = 20
"""Starts that are tried before a seed is given up."""
_OWN = 2
"""Number of the random stream among those that begin like the layout's."""


def disturb(worlds: Worlds, task: ControlTask, slots: Sequence[int]) -> None:
    """Make the picks and places that a task says its episodes start with; none of them is history.

    Raises:
        WarpDeformError: a seed gave no valid start.
    """
    if not task.first_actions:
        return
    before = {slot: worlds.state(slot) for slot in slots}
    rngs = {
        slot: np.random.default_rng([worlds.episodes[slot].seed, LAYOUT_STREAM, _OWN])
        for slot in slots
    }
    waiting = list(slots)
    for _ in range(_DRAWS):
        for _ in range(task.first_actions):
            worlds.step(
                {
                    slot: task.first_action(worlds.episodes[slot].snapshot, rngs[slot])
                    for slot in waiting
                }
            )
        for slot in tuple(waiting):
            if _forget(worlds, slot, before[slot].episode, task):
                waiting.remove(slot)
            else:
                discarded = worlds.episodes[slot].discarded_starts
                worlds.restore(slot, before[slot])
                worlds.episodes[slot].discarded_starts = discarded + 1
        if not waiting:
            return
    seeds = ", ".join(str(worlds.episodes[slot].seed) for slot in waiting)
    raise WarpDeformError(f"{task.name}: no valid start in {_DRAWS} draws for seed {seeds}")


def _forget(worlds: Worlds, slot: int, first: RunningEpisode, task: ControlTask) -> bool:
    """Whether a start is valid; then nothing is left of how it came about."""
    episode = worlds.episodes[slot]
    if not episode.physics_ok or not task.starts_like(episode.layout, episode.snapshot):
        return False
    episode.history, episode.ended, episode.over = (), False, False
    episode.tip, episode.posture = first.tip.copy(), first.posture
    worlds.look(slot)
    return True
