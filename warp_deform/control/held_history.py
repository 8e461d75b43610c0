"""What tips have carried, told as whole actions: rules of tasks ask for an episode's actions."""

from __future__ import annotations

import numpy as np

from ..objects.scene_object import object_of
from ..robots.primitive import LIFT, Outcome
from ..tasks.history import Aloft, PastAction
from ..tasks.task import Task
from ..worlds.episode import RunningEpisode

__all__ = ["HeldHistory"]


class HeldHistory:
    """Follows one episode: from a take to the next release is a pick and place of its history.

    Its lift is the greatest height that the tip had meanwhile, within the limits of actions.
    """

    def __init__(self) -> None:
        self._held: int | None = None
        self._pick, self._highest = np.zeros(4), 0.0
        self._aloft: Aloft | None = None

    def take(self, episode: RunningEpisode, *, particle: int | None, body: int | None) -> None:
        """Note that a particle or a body is held from now on."""
        episode.over |= episode.ended
        self._held = object_of(episode.objects, particle, body)
        self._pick, self._highest = episode.tip.copy(), float(episode.tip[2])
        self._aloft = None

    def follow(self, episode: RunningEpisode, task: Task) -> None:
        """Note a control step, after its snapshot was taken."""
        if self._held is None or episode.tip[2] < self._highest:
            return
        self._highest = float(episode.tip[2])
        if task.looks_aloft:
            self._aloft = Aloft(episode.snapshot.particle_q, episode.snapshot.body_q)

    def let_go(self, episode: RunningEpisode) -> None:
        """Write what was carried into the episode's history."""
        if self._held is None:
            return
        lift = float(np.clip(self._highest, *LIFT))
        pick, place = self._pick[[0, 1, 3]], episode.tip[[0, 1, 3]]
        action = np.concatenate([pick, place, [lift]])
        episode.history += (PastAction(action, Outcome.PLACED, self._held, self._aloft),)
        self._held = None
