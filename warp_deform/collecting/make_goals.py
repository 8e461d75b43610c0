"""Sets of goals for goal-conditioned tasks: last states of demonstrations, or made on purpose."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..episodes import Episode, EpisodeReader, EpisodeWriter, Step, combine_hashes, rebuild_index
from ..errors import InputError, WarpDeformError
from ..support.progress import progress_bar
from ..tasks.registry import task as find_task
from ..tasks.task import Task
from ..worlds.loop import SLOTS, EpisodeRun, play
from ..worlds.worlds import Worlds
from .collect import CollectConfig, collect
from .folder import Attempt, Collection, append_attempt, check_seeds
from .goals import CONSTRUCTED, DEMONSTRATED, at_goal
from .recording import GOAL_TARGETS, observe, origin, record, task_config
from .settings import DemonstratorName
from .workers import single_threaded

__all__ = ["GOAL_SEED", "make_goals"]

GOAL_SEED = 100_000
"""First seed of goals, away from those of training, validation and test."""


def make_goals(
    task: str,
    out: Path,
    *,
    count: int,
    seed: int = GOAL_SEED,
    kind: str = DEMONSTRATED,
    demonstrator: DemonstratorName = "scripted",
    robot: str = "ur5",
    workers: int | None = None,
) -> dict[str, Any]:
    """Make `count` goals of a goal-conditioned task in a folder; goes on with what is there.

    Returns task, kind, goals, attempts, seconds [s], physics_ok and state_hash.

    Source: Seita et al., ICRA 2021, section on goal-conditioned tasks.

    Args:
        kind: "demonstrated" keeps a demonstrator's successes on the seeds, whose last states are
            the goals (the paper's protocol); "constructed" places the objects at sampled targets
            and lets them settle, which takes no demonstrator but the default

    Raises:
        InputError: the task has no goal, the kind or the demonstrator is unknown, or the folder
            holds something else.
    """
    if not find_task(task).goal_conditioned:
        raise InputError(f"{task} has no goal image; goals are for goal-conditioned tasks")
    if count < 1:
        raise InputError(f"count is {count}; it must be 1 or more")
    began = time.perf_counter()
    if kind == CONSTRUCTED:
        if demonstrator != "scripted":
            raise InputError(f"constructed goals need no demonstrator: leave out {demonstrator!r}")
        check_seeds(seed, count)
        _construct(task, Path(out), range(seed, seed + count), robot)
        attempts = count
    elif kind == DEMONSTRATED:
        config = CollectConfig(
            task=task,
            episodes=count,
            seed=seed,
            out=out,
            demonstrator=demonstrator,
            robot=robot,
            workers=workers,
        )
        attempts = collect(config).attempts
    else:
        raise InputError(f"kind is {kind!r}; it must be {DEMONSTRATED!r} or {CONSTRUCTED!r}")
    infos = EpisodeReader(out).infos()
    return {
        "task": task,
        "kind": kind,
        "goals": len(infos),
        "attempts": attempts,
        "seconds": time.perf_counter() - began,
        "physics_ok": all(info.physics_ok for info in infos),
        "state_hash": combine_hashes(info.state_hash for info in infos),
    }


def _construct(name: str, out: Path, seeds: range, robot: str) -> None:
    """Store a one-row episode for every seed, unless it is there."""
    task = find_task(name)
    config = task_config(task)
    description = {"task": name, "robot": robot, "kind": CONSTRUCTED, "seed": seeds.start}
    with (
        Collection(out, {**description, "config": config}).owned() as collection,
        single_threaded(),
    ):
        missing = [seed for seed in seeds if seed not in collection.attempts]
        done = len(seeds) - len(missing)
        worlds = Worlds(at_goal(task), SLOTS, robot=robot, lanes=SLOTS)
        writer = EpisodeWriter(out, overwrite=True)
        runs = play(worlds, missing, act=_rest, look=observe, until_solved=False)
        with progress_bar(f"goals {name}", len(seeds), done=done, unit="goals") as advance:
            for slot, run in runs:
                if not run.rows:
                    raise WarpDeformError(f"{name}: no goal of seed {run.seed}: {run.ended}")
                writer.write(_goal_episode(worlds, slot, run, task))
                attempt = Attempt(run.seed, True, 0, run.rows[0].score, CONSTRUCTED)
                append_attempt(out, attempt)
                collection.attempts[run.seed] = attempt
                advance()
        collection.keep(set(seeds))
    rebuild_index(out)


def _rest(worlds: Worlds, runs: Mapping[int, EpisodeRun[Step]]) -> dict[int, np.ndarray | None]:
    """Do nothing."""
    return dict.fromkeys(runs)


def _goal_episode(worlds: Worlds, slot: int, run: EpisodeRun[Step], task: Task) -> Episode:
    """A slot's state as a goal of the task: one row, at which it is done."""
    made = record(worlds, slot, run, demonstrator=CONSTRUCTED)
    goal = worlds.as_goal(slot, kind=CONSTRUCTED)
    extra = {**origin(task), GOAL_TARGETS: goal.targets.tolist()}
    return Episode(
        info=replace(made.info, success=True, config=task_config(task), extra=extra),
        steps=(replace(made.steps[0], success=True),),
        goal=goal,
    )
