"""Demonstrations by the thousand: in parallel, resumable, the same files whatever the workers.

The kept episodes are the first N successes in the order of their seeds. An episode depends on its
seed alone, so how seeds are spread over slots, processes and interrupted runs cannot show.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .collection import Attempt, Collection, append_attempt
from .episode_loop import SOLVED, demonstrate, play
from .episodes import EpisodeReader, EpisodeWriter, Goal, combine_hashes, rebuild_index
from .errors import InputError
from .goals import load_goals
from .recording import observe, record, task_config
from .robots import robot as find_robot
from .tasks.registry import task as find_task
from .workers import Workers, stop_if_orphaned, worker_count
from .worlds import Worlds

__all__ = ["CollectConfig", "CollectReport", "collect"]

SLOTS = 8
"""Episodes that run side by side in one process: one group of SIMD lanes."""
CHUNK = 16, 64
"""Fewest and most seeds that a process takes at once: lanes run empty at a chunk's end."""
CHUNKS_PER_WORKER = 4
MOST_SEED = 999_999_999
FILMED = 2
"""Episodes in a video."""


@dataclass(frozen=True, kw_only=True)
class CollectConfig:
    """What to collect.

    episodes: successes to keep; seed: first seed, the others follow
    goals: folder of goals (see `make_goals`) that the attempts aim at in turn; None constructs one
        from every seed
    workers: processes; None takes one per core, but not for a handful of episodes
    ray: address of a Ray cluster whose machines share the folder
    video: MP4 of the first kept episodes
    """

    task: str
    episodes: int
    out: Path
    seed: int = 0
    demonstrator: str = "scripted"
    robot: str = "ur5"
    goals: Path | None = None
    workers: int | None = None
    ray: str | None = None
    video: Path | None = None

    def __post_init__(self) -> None:
        find_task(self.task)
        find_robot(self.robot)
        if self.episodes < 1:
            raise InputError(f"episodes is {self.episodes}; it must be 1 or more")
        if not 0 <= self.seed <= MOST_SEED - most_attempts(self.episodes):
            raise InputError(f"seed {self.seed} leaves no room below {MOST_SEED}")
        if self.demonstrator != "scripted":
            raise InputError(
                f"{self.task} has no demonstrator {self.demonstrator!r}; it has: scripted"
            )


@dataclass(frozen=True)
class CollectReport:
    """What was collected.

    attempts: seeds up to the one of the last kept success; mean_actions, mean_score, sim_seconds
    [s] and physics_ok are of the kept episodes; seconds: what this run took [s]
    state_hash: of the kept episodes' hashes in the order of their seeds
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


def most_attempts(episodes: int) -> int:
    """Attempts after which a collection gives up: the success rate is then below 5 %."""
    return 20 * episodes + 200


def collect(config: CollectConfig) -> CollectReport:
    """Collect into a folder; go on where an earlier run of the same collection stopped.

    The folder then holds the first `episodes` successes, or fewer where `most_attempts` did not
    give more.

    Raises:
        InputError: the folder belongs to another collection; nothing in it changes.
        WarpDeformError: a worker process was killed; what it had finished is kept.
    """
    began = time.perf_counter()
    if config.video is not None:
        from .filming import check_video

        check_video(config.video)
    config = replace(config, out=Path(config.out).resolve())
    count = worker_count(config.workers, config.episodes)
    with Collection(config.out, _description(config)).owned() as collection:
        with _progress(config) as progress, Workers(count, ray=config.ray) as workers:
            bar = progress.add_task(config.task, total=config.episodes)
            first = True
            while todo := _plan(config, collection.attempts):
                # The first few run here: they compile the kernels once, and show what goes wrong.
                here = first or len(todo) <= SLOTS
                batch = todo[:SLOTS] if first and workers.apart else todo
                chunks = [_Chunk(config, tuple(seeds)) for seeds in _split(batch, 1 if here else count)]
                crew = Workers(1) if here else workers
                for attempt in crew.run(attempt_chunk, chunks):
                    collection.attempts[attempt.seed] = attempt
                    kept, _ = _kept(config, collection.attempts)
                    progress.update(bar, completed=len(kept))
                first = False
        kept, attempts = _kept(config, collection.attempts)
        collection.keep(set(kept))
        report = _report(config, kept, attempts)
    if config.video is not None and kept:
        from .filming import film

        film(config.out, config.video, seeds=kept[:FILMED])
    return replace(report, seconds=time.perf_counter() - began)
