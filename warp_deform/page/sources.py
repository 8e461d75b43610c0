"""What `warp-deform view` opens: a folder of episodes, as a list and one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ..collecting.recording import recorded_task
from ..collecting.replay import Recording
from ..episodes import Episode, EpisodeReader, Goal
from ..errors import InputError

__all__ = ["Entry", "EpisodeSource", "Shown", "Source"]


@dataclass(frozen=True)
class Entry:
    """One episode of a list.

    Attributes:
        key: its number in the list
        group: what it is of, where a source holds several lists
        who: who acted
        kind: how it failed; empty where it succeeded or nobody has looked
        trouble: why it cannot be read, empty where it can
    """

    key: int
    seed: int
    task: str = ""
    group: str = ""
    who: str = ""
    success: bool = False
    score: float = 0.0
    actions: int = 0
    kind: str = ""
    trouble: str = ""


@dataclass(frozen=True, eq=False)
class Shown:
    """An episode as it is shown.

    Attributes:
        goal: the one it was given, None where the start makes it
        actions: (7,) each
        hashes: of the states at the start and after every action; empty where none were recorded
        pictures: colour (H, W, 3) uint8 of every state, where there is nothing to simulate
        scores: of every state, where they were recorded
        outcomes: of every action, where they were recorded
    """

    task: str
    robot: str
    seed: int
    goal: Goal | None
    actions: Sequence[np.ndarray]
    hashes: Sequence[str] = ()
    pictures: Sequence[np.ndarray] = ()
    scores: Sequence[float] = ()
    outcomes: Sequence[str] = ()


class Source(Protocol):
    """Where episodes come from."""

    title: str
    at_once: int
    """Pictures that a page asks for at a time: few where each takes long."""

    def entries(self) -> list[Entry]:
        """All episodes, damaged ones among them."""

    def thumbnail(self, key: int) -> np.ndarray | None:
        """Colour (H, W, 3) uint8 of an episode's last state; None where nobody has a picture."""

    def show(self, key: int) -> Shown:
        """An episode as it is to be shown; InputError where it cannot be read."""


class EpisodeSource:
    """A folder of episodes: demonstrations, a person's, or packed recordings of a robot.

    Args:
        kind: tells how an episode failed

    Raises:
        InputError: there is none.
    """

    at_once = 24

    def __init__(self, folder: Path, *, kind: Callable[[Episode], str] | None = None) -> None:
        self.title = str(folder)
        self._reader = EpisodeReader(folder)
        self._kind = kind
        self._recording = Recording(self._reader)

    def entries(self) -> list[Entry]:
        """See `Source.entries`."""
        return [self._entry(key, seed) for key, seed in enumerate(self._reader.seeds)]

    def _entry(self, key: int, seed: int) -> Entry:
        try:
            info = self._reader.info(seed)
            failed = self._kind is not None and not info.success
            kind = self._kind(self._reader.read(seed)) if failed and self._kind else ""
        except InputError as error:
            return Entry(key, seed, trouble=str(error))
        return Entry(
            key,
            seed,
            task=info.task,
            who=info.demonstrator,
            success=info.success,
            score=info.score,
            actions=info.actions,
            kind=kind,
        )

    def thumbnail(self, key: int) -> np.ndarray | None:
        """See `Source.thumbnail`."""
        seed = self._reader.seeds[key]
        return self._reader.read_step(seed, self._reader.info(seed).actions).color

    def show(self, key: int) -> Shown:
        """See `Source.show`."""
        seed = self._reader.seeds[key]
        episode = self._reader.read(seed)
        simulated = bool(episode.info.state_hash)
        goal = episode.goal
        if simulated:
            recorded_task(episode.info)
            goal = self._recording.goal(seed)
            self._recording.episodes.pop(seed, None)
        return Shown(
            task=episode.info.task,
            robot=episode.info.robot,
            seed=seed,
            goal=goal,
            actions=[step.action for step in episode.steps if step.action is not None],
            hashes=[step.state_hash for step in episode.steps] if simulated else (),
            pictures=() if simulated else [step.color for step in episode.steps],
            scores=[step.score for step in episode.steps],
            outcomes=[step.outcome for step in episode.steps if step.outcome is not None],
        )
