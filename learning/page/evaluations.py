"""What a training run's evaluations played, as a source of `warp-deform view`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.page.sources import Entry, Shown
from warp_deform.worlds.worlds import Worlds

from ..evaluation.play import play_policy
from ..evaluation.protocol import Protocol, goals_for, goals_of
from ..evaluation.snapshot import read_played
from ..evaluation.summary import PlayedEpisode
from ..policy.policy import ImagePolicy, StatePolicy, load_policy
from ..runs.folder import RunFolder, read_json

__all__ = ["EvaluationSource"]


class EvaluationSource:
    """Every episode that snapshots of a run have played; opening one plays it again.

    Raises:
        InputError: this is no run, nothing of it was evaluated, or a file is damaged.
    """

    at_once = 1

    def __init__(self, path: Path) -> None:
        self.title = str(path)
        self._run = RunFolder(path)
        self._played: list[tuple[dict[str, Any], PlayedEpisode]] = []
        for file in sorted(self._run.evaluations.glob("*.json")):
            record = read_json(file)
            self._played += [(record, played) for played in read_played(file).values()]
        if not self._played:
            raise InputError(f"{path} holds no evaluation; `warp-deform eval {path}` makes one")
        self._settings = self._run.read_settings()
        self._shown: dict[int, tuple[Shown, np.ndarray | None]] = {}
        self._worlds: dict[str, Worlds] = {}
        self._policy: tuple[int, ImagePolicy | StatePolicy] | None = None

    def entries(self) -> list[Entry]:
        """See `Source.entries`."""
        agent = self._settings["agent"]
        return [
            Entry(
                key,
                played.seed,
                task=agent["task"],
                group=f"{record['protocol']['split']}, step {record['step']}",
                who=agent["agent"],
                success=played.success,
                score=played.score,
                actions=played.actions,
                kind=played.failure or "",
            )
            for key, (record, played) in enumerate(self._played)
        ]

    def thumbnail(self, key: int) -> np.ndarray | None:
        """See `Source.thumbnail`: an evaluation keeps no pictures, so the episode is played."""
        try:
            return self._play(key)[1]
        except InputError:  # who opens it is told why
            return None

    def show(self, key: int) -> Shown:
        """See `Source.show`.

        Raises:
            InputError: the episode comes out differently here.
        """
        return self._play(key)[0]

    def _play(self, key: int) -> tuple[Shown, np.ndarray | None]:
        """An episode, and how it ended, where that can be drawn."""
        if key not in self._shown:
            self._shown[key] = self._play_again(key)
        return self._shown[key]

    def _play_again(self, key: int) -> tuple[Shown, np.ndarray | None]:
        record, played = self._played[key]
        if self._policy is None or self._policy[0] != record["step"]:
            self._policy = record["step"], load_policy(self._run.snapshot(record["step"]))
        policy = self._policy[1]
        task = policy.description.task
        protocol = _protocol(record["protocol"], played.seed)
        folder = goals_for(self._run, task, protocol)
        goals = None if folder is None else goals_of(folder, protocol, [played.seed])
        if protocol.robot not in self._worlds:
            self._worlds[protocol.robot] = Worlds(task, 1, robot=protocol.robot)
        worlds = self._worlds[protocol.robot]
        [(_, again, run)] = play_policy(policy, worlds, protocol, [played.seed], goals)
        ended = worlds.episodes[0]
        picture = ended.snapshot.images.color.copy() if ended.physics_ok else None
        if (again.success, again.actions, again.score) != (
            played.success,
            played.actions,
            played.score,
        ):
            raise InputError(
                f"seed {played.seed} comes out differently here ({again.actions} actions, score "
                f"{again.score:.3f}) than it was evaluated: another version or processor"
            )
        shown = Shown(
            task=task,
            robot=protocol.robot,
            seed=played.seed,
            goal=None if goals is None else goals[played.seed],
            actions=run.actions,
            outcomes=run.outcomes,
        )
        return shown, picture


def _protocol(described: dict[str, Any], seed: int) -> Protocol:
    """The protocol of a file of results, up to the episode of a seed."""
    known = {field.name for field in fields(Protocol)} - {"episodes", "goal_folder"}
    settings = {k: v for k, v in described.items() if k in known and v is not None}
    if settings.get("goals") not in ("constructed", "demonstrated"):
        raise InputError(
            "it was played for goals of a folder that was given; only its result is kept"
        )
    first = Protocol(**settings, episodes=1).seeds.start
    return Protocol(**settings, episodes=seed - first + 1)
