"""Simulate recorded episodes again, from their seeds and actions, and compare."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..episodes import Episode, EpisodeReader, Goal, Step, cpu_fingerprint, versions
from ..episodes.goals import goal_is_own
from ..errors import InputError
from ..support.progress import progress_bar
from ..tasks.registry import task as find_task
from ..worlds.loop import SLOTS, EpisodeRun, play, worlds_for
from ..worlds.worlds import Worlds
from .control_episodes import ControlSetup
from .control_replay import ReplayedControl, compare_control_chunk, setup_of
from .goals import CONSTRUCTED, at_goal
from .recording import recorded_task
from .workers import Workers, worker_count

__all__ = ["Recording", "verify"]

_CHUNK = 32


def verify(
    folder: Path, *, tolerance: float | None = None, workers: int | None = None
) -> dict[str, Any]:
    """Simulate every episode of a folder again and compare every row.

    Returns episodes, steps (rows), mismatches (rows that differ or were not reached), max_error
    [m], and whether the recording's processor and versions are the "same" or "other".

    Args:
        tolerance: None compares states bit by bit, scores and successes exactly; else positions of
            particles and bodies may differ by so much [m], and only they are compared: for another
            processor or version.

    Raises:
        InputError: the folder has no episodes, one is damaged, was not simulated, or is of a task
            that is not known here.
    """
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise InputError(f"tolerance is {tolerance}; it must be a distance in metres, 0 or more")
    reader = EpisodeReader(folder, control=True)
    groups: dict[tuple[str, str, bool], list[int]] = {}
    controlled: dict[ControlSetup, list[int]] = {}
    own = cpu_fingerprint(), versions()
    same_cpu = same_versions = True
    for seed in reader.seeds:
        info = reader.info(seed)
        if info.control is not None:
            controlled.setdefault(setup_of(info), []).append(seed)
        else:
            recorded_task(info)
            kind = info.task, info.robot, info.demonstrator == CONSTRUCTED
            groups.setdefault(kind, []).append(seed)
        same_cpu &= info.cpu == own[0]
        same_versions &= info.versions == own[1]
    count = worker_count(workers, len(reader))
    size = min(_CHUNK, math.ceil(len(reader) / count))
    chunks = [
        _Chunk(Path(folder).resolve(), *kind, tuple(seeds[i : i + size]), tolerance)
        for kind, seeds in groups.items()
        for i in range(0, len(seeds), size)
    ]
    control_chunks = [
        ReplayedControl(Path(folder).resolve(), how, tuple(seeds[i : i + size]), tolerance)
        for how, seeds in controlled.items()
        for i in range(0, len(seeds), size)
    ]
    comparisons = []
    with Workers(count) as crew, progress_bar("replay", len(reader)) as advance:
        for compared in itertools.chain(
            crew.run(_compare_chunk, chunks) if chunks else (),
            crew.run(compare_control_chunk, control_chunks) if control_chunks else (),
        ):
            comparisons.append(compared)
            advance()
    return {
        "episodes": len(comparisons),
        "steps": sum(rows for rows, _, _ in comparisons),
        "mismatches": sum(wrong for _, wrong, _ in comparisons),
        "max_error": max(error for _, _, error in comparisons),
        "cpu": "same" if same_cpu else "other",
        "versions": "same" if same_versions else "other",
    }


class Recording:
    """Recorded episodes as players of `play`: their goals and their actions, by seed.

    Raises:
        InputError: an episode was not simulated.
    """

    def __init__(self, reader: EpisodeReader) -> None:
        self._reader = reader
        self.episodes: dict[int, Episode] = {}

    def goal(self, seed: int) -> Goal | None:
        """The recorded goal; None where the start makes it anew, from the episode's own seed.

        A start that was drawn again had its own goal each time, which only making it repeats.
        """
        episode = self._episode(seed)
        goal = episode.goal
        own = goal is not None and goal.kind == CONSTRUCTED and goal_is_own(episode.info)
        return None if own else goal

    def act(
        self, worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]
    ) -> dict[int, np.ndarray | None]:
        """The recorded actions, one after the other."""
        return {
            slot: self._episode(run.seed).steps[len(run.actions)].action
            for slot, run in runs.items()
        }

    def _episode(self, seed: int) -> Episode:
        if seed not in self.episodes:
            episode = self._reader.read(seed)
            if not all(step.state_hash for step in episode.steps):
                path = self._reader.path(seed)
                raise InputError(f"{path} was not simulated, so it cannot be replayed")
            self.episodes[seed] = episode
        return self.episodes[seed]


@dataclass(frozen=True)
class _Chunk:
    folder: Path
    task: str
    robot: str
    constructed: bool
    seeds: tuple[int, ...]
    tolerance: float | None


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a replayed state is compared by."""

    state_hash: str
    score: float
    success: bool
    points: np.ndarray


def _compare_chunk(chunk: _Chunk) -> Iterator[tuple[int, int, float]]:
    """Number of rows, of differing rows, and the largest distance [m], for every episode."""
    recording = Recording(EpisodeReader(chunk.folder))
    if chunk.constructed:
        worlds = Worlds(at_goal(find_task(chunk.task)), SLOTS, robot=chunk.robot, lanes=SLOTS)
    else:
        worlds = worlds_for(chunk.task, chunk.robot)

    def look(worlds: Worlds, slot: int) -> _Seen:
        snapshot = worlds.episodes[slot].snapshot
        points = _points(snapshot.particle_q, snapshot.body_q)
        # a constructed goal counts as a success, but has no goal to be compared with
        success = chunk.constructed or worlds.solved(slot)
        return _Seen(worlds.hash(slot), float(worlds.score(slot)), success, points)

    goals = None if chunk.constructed else recording.goal
    runs = play(worlds, chunk.seeds, act=recording.act, look=look, goals=goals, until_solved=False)
    for _, run in runs:
        steps = recording.episodes.pop(run.seed).steps
        wrong, largest = len(steps) - len(run.rows), 0.0
        for step, seen in zip(steps, run.rows, strict=False):
            error = _distance(step, seen)
            same = (seen.state_hash, seen.score, seen.success) == (
                step.state_hash,
                step.score,
                step.success,
            )
            wrong += not same if chunk.tolerance is None else not error <= chunk.tolerance
            largest = max(largest, error)
        yield len(steps), wrong, largest


def _points(particle_q: np.ndarray, body_q: np.ndarray) -> np.ndarray:
    """Positions (P + B, 3) [m] of particles and bodies."""
    return np.concatenate([particle_q, body_q[:, :3]])


def _distance(step: Step, seen: _Seen) -> float:
    """Largest distance [m] between a recorded and a replayed position."""
    points = _points(step.particle_q, step.body_q)
    if points.shape != seen.points.shape:
        raise InputError(
            f"the recording has {len(points)} particles and bodies, this version's task "
            f"{len(seen.points)}; replay it with the version that recorded it"
        )
    return float(np.linalg.norm(points - seen.points, axis=1).max())
