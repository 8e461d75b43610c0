"""Who else may act at the page: the demonstrators, and policies that are handed in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..planning.demonstrators import DEMONSTRATORS, demonstrator
from ..tasks.task import Action
from ..worlds.loop import EpisodeRun
from ..worlds.worlds import Worlds

__all__ = ["DemonstratorPlayer", "Player", "Sight", "demonstrators"]


@dataclass(frozen=True, eq=False)
class Sight:
    """Where somebody looks: probabilities (320, 160) of a pick, and of a place given that pick."""

    pick: np.ndarray
    place: np.ndarray


class Player(Protocol):
    """Somebody who acts in slot 0 of worlds."""

    name: str
    looks: bool
    """Whether it has heat maps to show."""

    def begin(self) -> None:
        """Forget what was before: another episode begins, or an action was taken back."""

    def aside(self) -> Player:
        """The same one, whose choices are not remembered by this one."""

    def choose(self, worlds: Worlds, run: EpisodeRun[Any]) -> Action | None:
        """The next action (7,), None where it sees nothing to do."""

    def sight(self, worlds: Worlds, action: Action) -> Sight | None:
        """Where it looks in the present state, given the pick of `action`; None without maps."""


class DemonstratorPlayer:
    """One of the package's demonstrators; see `planning.demonstrators`."""

    looks = False

    def __init__(self, name: str) -> None:
        self.name = name
        self._act = demonstrator(name)

    def begin(self) -> None:
        """Nothing: it sees the state and no history."""

    def aside(self) -> Player:
        """Itself: it remembers nothing."""
        return self

    def choose(self, worlds: Worlds, run: EpisodeRun[Any]) -> Action | None:
        """See `Player.choose`."""
        return self._act(worlds, {0: run})[0]

    def sight(self, worlds: Worlds, action: Action) -> Sight | None:
        """None: it has no heat maps."""
        return None


def demonstrators(others: Iterable[Player] = ()) -> dict[str, Player]:
    """Players by name: those handed in, then the demonstrators."""
    players: list[Player] = [*others, *map(DemonstratorPlayer, DEMONSTRATORS)]
    return {player.name: player for player in players}
