"""The folder that a person's episodes go to: solved ones as demonstrations, others beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..collecting.recording import record
from ..episodes import EpisodeReader, EpisodeWriter, Step, episode_name
from ..errors import InputError
from ..worlds.loop import SOLVED, EpisodeRun
from ..worlds.worlds import Worlds

__all__ = ["HUMAN", "UNSOLVED", "KeptEpisodes"]

HUMAN = "human"
"""Who demonstrated an episode in which a person chose every action."""
MIXED = "human and others"
"""The same where somebody else chose some."""
UNSOLVED = "unsolved"
"""Folder, within that of the demonstrations, of episodes that were kept without being solved."""
_ACTED = "acted"
"""Where an episode says who chose each of its actions."""


class KeptEpisodes:
    """The folder of a session with `--record`.

    Training takes the folder as it is, so that only solved episodes are in it.

    Args:
        task: name of the task

    Raises:
        InputError: the folder holds another task's episodes, or cannot be written to.
    """

    def __init__(self, folder: Path, task: str) -> None:
        self.folder = Path(folder)
        self._writer = EpisodeWriter(self.folder)
        self.count = 0
        if any(self.folder.glob("episode_*.parquet")):
            infos = EpisodeReader(self.folder).infos()
            self.count = len(infos)
            for info in infos:
                if info.task != task:
                    raise InputError(
                        f"{self.folder} holds episodes of {info.task}; name another folder for "
                        f"those of {task}"
                    )

    def free_seed(self, first: int) -> int:
        """The first seed from `first` on of which no episode is kept."""
        folders = (self.folder, self.folder / UNSOLVED)
        seed = first
        while any((folder / episode_name(seed)).exists() for folder in folders):
            seed += 1
        return seed

    def keep(self, worlds: Worlds, run: EpisodeRun[Step], acted: list[str]) -> Path:
        """Write the episode of slot 0 and return its file.

        Args:
            acted: who chose each action

        Raises:
            InputError: nothing was done, its physics cannot be trusted, or its seed is there.
        """
        if not run.actions:
            raise InputError("nothing has been done yet that could be kept")
        if not worlds.episodes[0].physics_ok:
            raise InputError("a guard fired: what cannot be trusted is not kept; undo or reset")
        solved = worlds.solved(0)
        run.ended = SOLVED if solved else "left by the person at the page"
        who = HUMAN if set(acted) == {HUMAN} else MIXED
        episode = record(worlds, 0, run, demonstrator=who)
        info = replace(episode.info, extra={**episode.info.extra, _ACTED: list(acted)})
        writer = self._writer if solved else EpisodeWriter(self.folder / UNSOLVED)
        path = writer.write(replace(episode, info=info))
        self.count += solved
        return path
