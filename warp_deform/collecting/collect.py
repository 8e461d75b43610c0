"""Demonstrations by the thousand: in parallel, resumable, the same files whatever the workers.

The kept episodes are the first N successes in the order of their seeds. An episode depends on its
seed alone, so how seeds are spread over slots, processes and interrupted runs cannot show.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from ..episodes import EpisodeReader, EpisodeWriter, combine_hashes, rebuild_index
from ..episodes.enclosed import enclosed_count
from ..errors import InputError
from ..planning.demonstrators import demonstrator
from ..robots import robot as find_robot
from ..support.progress import progress_bar
from ..tasks.registry import task as find_task
from ..worlds.loop import SLOTS, SOLVED, play, worlds_for
from .control_demos import ControlChunk, attempt_control_chunk, check_control, describe_control
from .control_video import film_control
from .folder import Attempt, Collection, append_attempt, check_seeds
from .goals import check_goals, goals_in_turn
from .recording import observe, record, task_config
from .settings import CollectSettings
from .video import check_video, film
from .workers import Workers, worker_count

__all__ = ["CollectConfig", "CollectReport", "collect"]

CHUNK = 16, 64
"""Fewest and most seeds that a process takes at once: lanes run empty at a chunk's end."""
CHUNKS_PER_WORKER = 4
FILMED = 2
"""Episodes in a video."""


@dataclass(frozen=True, kw_only=True)
class CollectConfig(CollectSettings):
    """The settings of a collection, checked."""

    def __post_init__(self) -> None:
        if self.control:
            check_control(self)
            if self.goals is not None:
                raise InputError("--goals does not go with --control")
        else:
            find_task(self.task)
            if self.goals is not None:
                check_goals(self.goals, self.task)
            self._refuse_control()
        find_robot(self.robot)
        if self.episodes < 1:
            raise InputError(f"episodes is {self.episodes}; it must be 1 or more")
        check_seeds(self.seed, most_attempts(self.episodes))
        demonstrator(self.demonstrator)

    def _refuse_control(self) -> None:
        """Raise InputError where something is asked for that goes with control alone."""
        for name in ("control_mode", "start", "horizon", "pictures", "evaluations"):
            usual = next(field.default for field in fields(self) if field.name == name)
            if getattr(self, name) != usual:
                flag = name.replace("_", "-")
                raise InputError(f"--{flag} goes with --control")


@dataclass(frozen=True)
class CollectReport:
    """What was collected.

    Attributes:
        attempts: seeds up to the one of the last kept success
        mean_actions: of the kept episodes
        mean_score: of the kept episodes
        seconds: what this run took [s]
        sim_seconds: of the kept episodes together [s]
        physics_ok: of the kept episodes, whether no guard fired
        state_hash: of the kept episodes' hashes in the order of their seeds
        enclosed: kept episodes whose bag enclosed its items, see `Task.enclosed`; None where there
            are none
    """

    task: str
    episodes: int
    attempts: int
    successes: int
    success_rate: float
    mean_actions: float
    mean_score: float
    seconds: float
    sim_seconds: float
    physics_ok: bool
    state_hash: str
    discarded_starts: int
    enclosed: int | None = None


def most_attempts(episodes: int) -> int:
    """Attempts after which a collection gives up: the success rate is then below 5 %."""
    return 20 * episodes + 200


def collect(config: CollectConfig) -> CollectReport:
    """Collect into a folder; go on where an earlier run of the same collection stopped.

    The folder then holds the first `episodes` successes, or fewer where `most_attempts` did not
    give more.

    Raises:
        InputError: the folder belongs to another collection, whose episodes stay as they are.
        WarpDeformError: a worker process was killed; what had been finished is kept.
    """
    began = time.perf_counter()
    if config.video is not None:
        check_video(config.video)
    config = replace(config, out=Path(config.out).resolve())
    count = config.workers
    if config.ray is None:
        count = worker_count(config.workers, config.episodes)
    workers = Workers(count, ray=config.ray)
    with Collection(config.out, _description(config)).owned() as collection:
        with workers:
            _attempt_all(config, collection.attempts, workers)
        successes, attempts = _kept(config, collection.attempts)
        collection.keep(set(successes))
    report = _report(config, successes, attempts, time.perf_counter() - began)
    if config.video is not None and successes:
        if config.control:
            film_control([config.out], config.video, seeds=successes[:FILMED])
        else:
            film(config.out, config.video, seeds=successes[:FILMED])
    return report


def _attempt_all(config: CollectConfig, attempts: dict[int, Attempt], workers: Workers) -> None:
    """Attempt seeds, round after round, until there are successes enough or no hope of them."""
    own_process = Workers(1)
    done = sum(attempt.success for attempt in attempts.values())
    with progress_bar(f"demo {config.task}", config.episodes, done=done) as advance:
        crew = own_process
        while todo := _plan(config, attempts):
            # The first few run here, while the workers start: kernels are compiled once.
            few = todo[:SLOTS] if crew is own_process and workers.apart else todo
            for attempt in _attempts(config, crew, _split(few, crew.count)):
                attempts[attempt.seed] = attempt
                advance(attempt.success)
                advance.note = f"{len(attempts)} attempts"
            crew = workers


def _attempts(
    config: CollectConfig, crew: Workers, parts: Sequence[tuple[int, ...]]
) -> Iterator[Attempt]:
    """Attempts of seeds, as they come."""
    if config.control:
        chunks = [ControlChunk(config, config.out, part) for part in parts]
        return crew.run(attempt_control_chunk, chunks)
    return crew.run(attempt_chunk, [_Chunk(config, part) for part in parts])


def _plan(config: CollectConfig, attempts: Mapping[int, Attempt]) -> list[int]:
    """Seeds that should bring the missing successes; none when they are there, or hopeless.

    The success rate so far says how many seeds a success takes.
    """
    rate = (sum(a.success for a in attempts.values()) + 1) / (len(attempts) + 1)
    todo: list[int] = []
    expected, seed = 0.0, config.seed
    end = config.seed + most_attempts(config.episodes)
    while seed < end and expected < config.episodes - 1e-6:
        if seed in attempts:
            expected += attempts[seed].success
        else:
            expected += rate
            todo.append(seed)
        seed += 1
    return todo


def _kept(config: CollectConfig, attempts: Mapping[int, Attempt]) -> tuple[list[int], int]:
    """Seeds of the first successes, and how many seeds it took to get them."""
    successes: list[int] = []
    for tried in range(most_attempts(config.episodes)):
        if len(successes) == config.episodes:
            return successes, tried
        attempt = attempts[config.seed + tried]
        if attempt.success:
            successes.append(attempt.seed)
    return successes, most_attempts(config.episodes)


def _split(seeds: Sequence[int], count: int) -> list[tuple[int, ...]]:
    """Neighbouring seeds in chunks for `count` processes, one chunk for the present one."""
    if count == 1:
        return [tuple(seeds)]
    size = math.ceil(len(seeds) / count / CHUNKS_PER_WORKER)
    size = min(max(size, CHUNK[0]), CHUNK[1], math.ceil(len(seeds) / count))
    return [tuple(seeds[i : i + size]) for i in range(0, len(seeds), size)]


@dataclass(frozen=True)
class _Chunk:
    config: CollectConfig
    seeds: tuple[int, ...]


def attempt_chunk(chunk: _Chunk) -> Iterator[Attempt]:
    """Attempt seeds; a success is a file, and every attempt a line of the ledger, at once."""
    config = chunk.config
    writer = EpisodeWriter(config.out, overwrite=True)  # by the same episode, if at all
    goals = goals_in_turn(config.goals)
    worlds, act = worlds_for(config.task, config.robot), demonstrator(config.demonstrator)
    for slot, run in play(worlds, chunk.seeds, act=act, look=observe, goals=goals):
        success = run.ended == SOLVED
        if success:
            writer.write(record(worlds, slot, run, demonstrator=config.demonstrator))
        score = run.rows[-1].score if run.rows else 0.0
        attempt = Attempt(run.seed, success, len(run.actions), score, run.ended or "")
        append_attempt(config.out, attempt)
        yield attempt


def _description(config: CollectConfig) -> dict[str, object]:
    """What all episodes of a collection have in common."""
    if config.control:
        return {
            "task": config.task,
            "robot": config.robot,
            "demonstrator": config.demonstrator,
            "seed": config.seed,
            "control": describe_control(config),
        }
    return {
        "task": config.task,
        "robot": config.robot,
        "demonstrator": config.demonstrator,
        "seed": config.seed,
        "goals": None
        if config.goals is None
        else [info.state_hash for info in EpisodeReader(config.goals).infos()],
        "config": task_config(find_task(config.task)),
    }


def _report(
    config: CollectConfig, successes: Sequence[int], attempts: int, seconds: float
) -> CollectReport:
    infos = EpisodeReader(config.out, control=True).infos() if successes else []
    if infos:
        rebuild_index(config.out)
    n = max(len(infos), 1)
    return CollectReport(
        task=config.task,
        episodes=config.episodes,
        attempts=attempts,
        successes=len(infos),
        success_rate=len(infos) / attempts,
        mean_actions=sum(info.actions for info in infos) / n,
        mean_score=sum(info.score for info in infos) / n,
        seconds=seconds,
        sim_seconds=math.fsum(info.sim_seconds for info in infos),
        physics_ok=all(info.physics_ok for info in infos),
        state_hash=combine_hashes(info.state_hash for info in infos),
        discarded_starts=sum(info.discarded_starts for info in infos),
        enclosed=enclosed_count(infos),
    )
