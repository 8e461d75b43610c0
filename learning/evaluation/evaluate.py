"""Evaluation: which snapshot is best on validation seeds, and how good it is on test seeds.

A snapshot is chosen on validation seeds and then plays the test seeds once. The paper's own
protocol, the best of ten snapshots on the test seeds themselves, is a second, labelled result: it
is optimistic.

Source: Seita et al., ICRA 2021, sections on training and evaluation; Wilson, JASA 1927.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from warp_deform.collecting.workers import Workers
from warp_deform.episodes import EpisodeReader, combine_hashes, versions
from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds.loop import SLOTS, worlds_for

from ..policy.policy import ImagePolicy, StatePolicy, load_policy
from ..runs.folder import Fields, RunFolder, check_fields, read_json, read_record, write_json
from .paper_results import partial_credit
from .play import Played, play_policy
from .protocol import Protocol, goals_for, goals_of

__all__ = [
    "Evaluation",
    "best",
    "evaluate_snapshot",
    "known",
    "measure",
    "stopped_early",
    "summarise",
    "trained_steps",
    "wilson",
]

_CHUNK = 2 * SLOTS
"""Episodes that a process is given at a time: what a kill loses, against idle lanes at the end."""


@dataclass(frozen=True)
class Evaluation:
    """A snapshot's episodes in the order of their seeds, and what they amount to."""

    step: int
    episodes: tuple[Played, ...]
    summary: dict[str, Any]


def evaluate_snapshot(
    run: RunFolder,
    step: int,
    protocol: Protocol,
    *,
    workers: int = 1,
    heard: Callable[[Played], object] | None = None,
) -> Evaluation:
    """Play a protocol with a snapshot of a run, or read what was played before.

    An episode depends on snapshot, seed and protocol alone, so neither the number of workers nor an
    interruption changes a result.

    Args:
        heard: called with every episode, those that were played before first

    Raises:
        InputError: there is no such snapshot, it cannot play this, or a file is damaged.
    """
    kept = _Kept(run, step, protocol)
    missing = [seed for seed in protocol.seeds if seed not in kept.played]
    if heard is not None:
        for seed in protocol.seeds:
            if seed in kept.played:
                heard(kept.played[seed])
    if missing:
        goals = goals_for(run, kept.task, protocol)
        count = min(workers, len(missing))
        size = math.ceil(len(missing) / count)
        if count > 1:  # results of other processes come a chunk at a time
            size = min(size, _CHUNK)
        chunks = [
            _Chunk(run.snapshot(step), kept.weights, protocol, goals, tuple(missing[i : i + size]))
            for i in range(0, len(missing), size)
        ]
        with Workers(count) as crew:
            for played in crew.run(_play_chunk, chunks):
                kept.add(played)
                if heard is not None:
                    heard(played)
    episodes = tuple(kept.played[seed] for seed in protocol.seeds)
    return Evaluation(step, episodes, summarise(episodes, task=kept.task))


def known(run: RunFolder, step: int, protocol: Protocol) -> bool:
    """Whether a snapshot has played all of a protocol."""
    return _Kept(run, step, protocol).whole


def stopped_early(run: RunFolder) -> bool:
    """Whether a run's validation ends its training: a snapshot solved every episode.

    Or, where the run has a `patience`, none did better for so long. By what is kept in the folder,
    for the versions that trained; nothing is played.

    Raises:
        InputError: this is no run's folder, or a file is damaged.
    """
    settings = run.read_settings()
    patience, episodes = settings.get("patience"), settings.get("validate", 0)
    if not episodes:
        return False
    protocol = Protocol(split="validation", episodes=episodes)
    values = []
    for step in filter(None, run.steps()):
        kept = _Kept(run, step, protocol, by=settings.get("versions"))
        if kept.whole:
            summary = summarise([kept.played[seed] for seed in protocol.seeds], task=kept.task)
            if summary["n_success"] == episodes:
                return True
            values.append(summary[measure(kept.task)])
    waited = len(values) - 1 - int(np.argmax(values or [0]))
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


def best(evaluations: Sequence[Evaluation], *, task: str) -> Evaluation:
    """The evaluation with the best result; of equals that with fewer actions, then the latest."""

    def rank(each: Evaluation) -> tuple[float, float, int]:
        return each.summary[measure(task)], -each.summary["mean_actions"], each.step

    return max(evaluations, key=rank)


def summarise(episodes: Sequence[Played], *, task: str) -> dict[str, Any]:
    """Numbers that episodes amount to.

    n_episodes, n_success, pc_success [%], pc_success_ci95: Wilson's interval [%], mean_score in
    [0, 1] with its standard_error, mean_actions, mean_actions_solved (of successes, None without),
    paper_value [%]: what the paper's table calls success, see `partial_credit`
    failures: how often each of `failures.FAILURES` happened
    goal_l2: mean of the last states' `goal_distance`, None where there is no goal
    n_success_enclosed: successes whose every item the bag enclosed, which scores do not ask for,
    see `Task.enclosed`; None where there is no bag or item
    """
    n, solved = len(episodes), [e for e in episodes if e.success]
    scores = np.array([e.score for e in episodes])
    mean, rate = float(scores.mean()), 100 * len(solved) / n
    failed = Counter(e.failure for e in episodes if e.failure is not None)
    distances = [e.goal_l2[-1] for e in episodes if e.goal_l2]
    bagged = [e for e in episodes if e.enclosed is not None]
    return {
        "n_episodes": n,
        "n_success": len(solved),
        "pc_success": rate,
        "pc_success_ci95": list(wilson(len(solved), n)),
        "mean_score": mean,
        "standard_error": float(scores.std(ddof=1) / math.sqrt(n)) if n > 1 else None,
        "mean_actions": float(np.mean([e.actions for e in episodes])),
        "mean_actions_solved": float(np.mean([e.actions for e in solved])) if solved else None,
        "paper_value": 100 * mean if partial_credit(task) else rate,
        "failures": dict(sorted(failed.items())),
        "goal_l2": float(np.mean(distances)) if distances else None,
        "n_success_enclosed": sum(e.success for e in bagged if e.enclosed) if bagged else None,
    }


def measure(task: str) -> str:
    """The key of a summary by which snapshots of a task are compared."""
    return "mean_score" if partial_credit(task) else "pc_success"


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval [%] of a share of successes.

    Examples:
        >>> [round(bound, 1) for bound in wilson(15, 20)]
        [53.1, 88.8]
    """
    interval = binomtest(successes, n).proportion_ci(method="wilson")
    return 100 * float(interval.low), 100 * float(interval.high)


@dataclass(frozen=True)
class _Chunk:
    """Episodes for one process. weights: hash of the snapshot's file"""

    snapshot: Path
    weights: str
    protocol: Protocol
    goals: Path | None
    seeds: tuple[int, ...]


def _play_chunk(chunk: _Chunk) -> Iterator[Played]:
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


class _Kept:
    """What a snapshot has played of a protocol so far, and the file that keeps it.

    A file's name is that of all that its episodes depend on, not of how many were played.

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
        self.played = _read_played(self._path)

    @property
    def whole(self) -> bool:
        """Whether all of the protocol has been played."""
        return self.played.keys() >= set(self._seeds)

    def add(self, played: Played) -> None:
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


def _read_played(path: Path) -> dict[int, Played]:
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
        episodes[entry["seed"]] = Played(**{name: values[name] for name in _PLAYED})
    return episodes
