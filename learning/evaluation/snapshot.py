"""A snapshot's evaluation: it plays the episodes of a protocol, once; results are kept in its run.

Source: Seita et al., ICRA 2021, sections on training and evaluation.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from warp_deform.collecting.workers import Workers
from warp_deform.episodes import EpisodeReader, combine_hashes, versions
from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds.loop import SLOTS, worlds_for

from ..policy.policy import ImagePolicy, StatePolicy, load_policy
from ..runs.folder import Fields, RunFolder, check_fields, read_json, read_record, write_json
from .play import play_policy
from .protocol import Protocol, goals_for, goals_of
from .summary import Evaluation, PlayedEpisode, summarise

__all__ = [
    "confirmed",
    "evaluate_snapshot",
    "is_evaluated",
    "read_played",
    "stopped_early",
    "trained_steps",
]

_CHUNK = 2 * SLOTS
"""Episodes that a process is given at a time: what a kill loses, against idle lanes at the end."""


def evaluate_snapshot(
    run: RunFolder,
    step: int,
    protocol: Protocol,
    *,
    workers: int = 1,
    on_episode: Callable[[PlayedEpisode], object] | None = None,
) -> Evaluation:
    """Play a protocol with a snapshot of a run, or read what was played before.

    An episode depends on snapshot, seed and protocol alone, so neither the number of workers nor an
    interruption changes a result.

    Args:
        on_episode: called with every episode, those that were played before first

    Raises:
        InputError: there is no such snapshot, it cannot play this, or a file is damaged.
    """
    results = _Results(run, step, protocol)
    missing = [seed for seed in protocol.seeds if seed not in results.played]
    if on_episode is not None:
        for seed in protocol.seeds:
            if seed in results.played:
                on_episode(results.played[seed])
    if missing:
        goals = goals_for(run, results.task, protocol)
        count = min(workers, len(missing))
        size = math.ceil(len(missing) / count)
        if count > 1:  # results of other processes come a chunk at a time
            size = min(size, _CHUNK)
        chunks = [
            _Chunk(
                run.snapshot(step), results.weights, protocol, goals, tuple(missing[i : i + size])
            )
            for i in range(0, len(missing), size)
        ]
        with Workers(count) as crew:
            for played in crew.run(_play_chunk, chunks):
                results.add(played)
                if on_episode is not None:
                    on_episode(played)
    episodes = tuple(results.played[seed] for seed in protocol.seeds)
    return Evaluation(step, episodes, summarise(episodes, task=results.task))


def is_evaluated(run: RunFolder, step: int, protocol: Protocol) -> bool:
    """Whether a snapshot has played all of a protocol."""
    return _Results(run, step, protocol).whole


def confirmed(run: RunFolder, step: int, protocol: Protocol) -> float:
    """Share solved of the further validation episodes that training asks of a good snapshot.

    0 for one that did not solve all of `protocol`, where the further ones were not all played, and
    where `protocol` is not what training plays.
    """
    settings = run.read_settings()
    confirm, n = settings["schedule"].get("confirm", 0), protocol.episodes
    if not confirm or n != settings.get("validate"):
        return 0.0
    played = _Results(run, step, protocol).played
    every = [played.get(seed) for seed in replace(protocol, episodes=n + confirm).seeds]
    if None in every or not all(each is not None and each.success for each in every[:n]):
        return 0.0
    return sum(each is not None and each.success for each in every[n:]) / confirm


def stopped_early(run: RunFolder) -> bool:
    """Whether a run's validation ends its training: a snapshot solved every episode it was given.

    Where the schedule has a `confirm`, those are so many more for a snapshot that solved all that
    every snapshot plays. Or, where the run has a `patience`, none for so long solved more than all
    before or had a better mean score. By what is kept in the folder, for the versions that trained;
    nothing is played.

    Raises:
        InputError: this is no run's folder, or a file is damaged.
    """
    settings = run.read_settings()
    patience, episodes = settings.get("patience"), settings.get("validate", 0)
    if not episodes:
        return False
    protocol = Protocol(split="validation", episodes=episodes)
    longer = replace(protocol, episodes=episodes + settings["schedule"].get("confirm", 0))
    values = []
    for step in filter(None, run.steps()):
        results = _Results(run, step, protocol, by=settings.get("versions"))
        if results.whole:
            played = [results.played[seed] for seed in protocol.seeds]
            solved = sum(each.success for each in played)
            if solved == episodes:
                further = [results.played.get(seed) for seed in longer.seeds[episodes:]]
                if all(each is not None and each.success for each in further):
                    return True
                solved += sum(each is not None and each.success for each in further)
            values.append((solved, summarise(played, task=results.task)["mean_score"]))
    waited, most = 0, (-1, -math.inf)
    for solved, score in values:
        waited = 0 if solved > most[0] or score > most[1] else waited + 1
        most = max(solved, most[0]), max(score, most[1])
    return patience is not None and waited >= patience


def trained_steps(run: RunFolder) -> int:
    """Steps that a run was trained for; of one that was handed on, those of the original.

    Raises:
        InputError: its training has not come to its end, or a file is damaged.
    """
    settings, steps = run.read_settings(), run.steps()
    planned = int(settings["schedule"]["steps"])
    if not any(steps):
        raise InputError(f"{run.path} has no snapshot yet; run `warp-deform train` to its end")
    if "rounded" in settings:
        return int(settings.get("trained_steps", planned))
    if steps[-1] < planned and not stopped_early(run):
        raise InputError(
            f"{run.path} is trained for {steps[-1]} of {planned} steps; run `warp-deform train` "
            "to its end"
        )
    return steps[-1]


@dataclass(frozen=True)
class _Chunk:
    """Episodes for one process.

    Attributes:
        weights: hash of the snapshot's file
    """

    snapshot: Path
    weights: str
    protocol: Protocol
    goals: Path | None
    seeds: tuple[int, ...]


def _play_chunk(chunk: _Chunk) -> Iterator[PlayedEpisode]:
    """Play episodes side by side; each is yielded when it is over."""
    policy = _policy(chunk.snapshot, chunk.weights)
    worlds = worlds_for(policy.description.task, chunk.protocol.robot)
    goals = None
    if chunk.goals is not None:
        goals = goals_of(chunk.goals, chunk.protocol, chunk.seeds)
    for _, played, _ in play_policy(policy, worlds, chunk.protocol, chunk.seeds, goals):
        yield played


@functools.lru_cache(maxsize=1)
def _policy(snapshot: Path, weights: str) -> ImagePolicy | StatePolicy:
    """This process's policy, loaded once for all chunks."""
    return load_policy(snapshot)


class _Results:
    """What a snapshot has played of a protocol so far, and the file that keeps it.

    A file's name is that of all that its episodes depend on, not of how many were played.

    Args:
        by: versions of the packages that played; None for those in force
    """

    def __init__(
        self,
        run: RunFolder,
        step: int,
        protocol: Protocol,
        *,
        by: Mapping[str, str] | None = None,
    ) -> None:
        snapshot = run.snapshot(step)
        self.task: str = read_record(snapshot)["agent"]["task"]
        self.weights = hashlib.blake2b(snapshot.read_bytes(), digest_size=8).hexdigest()
        self._seeds = protocol.seeds
        self._record = {
            "step": step,
            "weights": self.weights,
            "protocol": _described(protocol, self.task),
            "versions": versions() if by is None else dict(by),
        }
        text = json.dumps(self._record, sort_keys=True)
        key = hashlib.blake2b(text.encode(), digest_size=6).hexdigest()
        self._path = run.evaluations / f"step_{step:08d}-{protocol.split}-{key}.json"
        self.played = read_played(self._path)

    @property
    def whole(self) -> bool:
        """Whether all of the protocol has been played."""
        return self.played.keys() >= set(self._seeds)

    def add(self, played: PlayedEpisode) -> None:
        """Keep an episode."""
        self.played[played.seed] = played
        self._path.parent.mkdir(exist_ok=True)
        episodes = [asdict(self.played[seed]) for seed in sorted(self.played)]
        write_json(self._path, {**self._record, "episodes": episodes})


def _described(protocol: Protocol, task: str) -> dict[str, Any]:
    """A protocol as JSON, without what changes no episode of it."""
    described = asdict(protocol)
    if not protocol.makes_goals(task):
        described["n_goals"] = None
    del described["episodes"], described["goal_folder"]
    for name in ("first_seed", "motions_must_succeed"):  # of what was played before they were
        if not described[name]:
            del described[name]
    if (version := find_task(task).version) > 1:  # episodes by an older rule are others
        described["task_version"] = version
    if protocol.given is not None:
        # goals count by what they are, not by where they lie
        shown = (info.state_hash for info in EpisodeReader(protocol.given).infos())
        described["goals"] = combine_hashes(shown)
    return described


_PLAYED: Fields = {
    "seed": int,
    "success": bool,
    "score": float,
    "actions": int,
    "reason": str,
    "failure": (str, type(None)),
    "goal_l2": (list, type(None)),
    "enclosed": (bool, type(None)),
}


def read_played(path: Path) -> dict[int, PlayedEpisode]:
    """Episodes of a file of results, by their seeds; none where there is no file."""
    if not path.exists():
        return {}
    what = f"{path} is damaged, remove it to have its episodes played again"
    record = read_json(path)
    check_fields(record, {"episodes": list}, what=what)
    episodes = {}
    for entry in record["episodes"]:
        check_fields({"episode": entry}, {"episode": dict}, what=what)
        entry.setdefault("enclosed", None)  # as nobody asked once
        check_fields(entry, _PLAYED, what=what)
        distances = entry["goal_l2"]
        for distance in distances or ():
            check_fields({"goal_l2": distance}, {"goal_l2": float}, what=what)
        values = {**entry, "goal_l2": None if distances is None else tuple(distances)}
        episodes[entry["seed"]] = PlayedEpisode(**{name: values[name] for name in _PLAYED})
    return episodes
