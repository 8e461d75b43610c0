"""Sets of goals for goal-conditioned tasks: last states of demonstrations, or made on purpose.

A goal is stored as an episode whose last row shows it: a whole demonstration, or a single row. So
every folder of demonstrations is a set of goals too, and one reader serves both.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .collection import Attempt, Collection, append_attempt, check_seeds
from .episode_loop import SLOTS, Run, play
from .episodes import (
    Episode,
    EpisodeReader,
    EpisodeWriter,
    Goal,
    Step,
    combine_hashes,
    rebuild_index,
)
from .errors import InputError, WarpDeformError
from .progress import progress_bar
from .recording import GOAL_TARGETS, observe, origin, record, recorded_task, task_config
from .tasks.free_space import FreeSpace
from .tasks.registry import task as find_task
from .tasks.task import Layout, Snapshot, Task
from .workers import single_threaded
from .worlds import Worlds

__all__ = ["CONSTRUCTED", "GOAL_SEED", "at_goal", "load_goal", "load_goals", "make_goals"]

GOAL_SEED = 100_000
"""First seed of goals, away from those of training, validation and test."""
CONSTRUCTED = "constructed"
"""Kind of goal, and the demonstrator that the files of such goals name."""
_DEMONSTRATED = "demonstrated"
_FILE = re.compile(r"episode_(\d{9})\.parquet")


def make_goals(
    task: str,
    out: Path,
    *,
    count: int,
    seed: int = GOAL_SEED,
    kind: str = _DEMONSTRATED,
    demonstrator: str = "scripted",
    robot: str = "ur5",
    workers: int | None = None,
) -> dict[str, Any]:
    """Make `count` goals of a goal-conditioned task in a folder; goes on with what is there.

    kind: "demonstrated" keeps a demonstrator's successes on the seeds, whose last states are the
        goals (the paper's protocol); "constructed" places the objects at sampled targets and lets
        them settle, which takes no demonstrator but the default

    Returns task, kind, goals, attempts, seconds [s], physics_ok and state_hash.

    Raises:
        InputError: the task has no goal, the kind or the demonstrator is unknown, or the folder
            holds something else.

    Source: Seita et al., ICRA 2021, section on goal-conditioned tasks.
    """
    if not find_task(task).goal_conditioned:
        raise InputError(f"{task} has no goal image; goals are for goal-conditioned tasks")
    if count < 1:
        raise InputError(f"count is {count}; it must be 1 or more")
    began = time.perf_counter()
    if kind == CONSTRUCTED:
        if demonstrator != "scripted":
            raise InputError(f"constructed goals have no demonstrator, so not {demonstrator!r}")
        check_seeds(seed, count)
        _construct(task, Path(out), range(seed, seed + count), robot)
        attempts = count
    elif kind == _DEMONSTRATED:
        from .collect import CollectConfig, collect  # it reads goals in its turn

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
        raise InputError(f"kind is {kind!r}; it must be {_DEMONSTRATED!r} or {CONSTRUCTED!r}")
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


def load_goals(folder: Path) -> list[Goal]:
    """The goals of a folder, in the order of their seeds.

    Raises:
        InputError: the folder is missing or empty, or an episode in it shows no goal.
    """
    reader = EpisodeReader(folder)
    return [_goal(reader, seed) for seed in reader.seeds]


def load_goal(path: Path) -> Goal:
    """The goal of one episode file.

    Raises:
        InputError: the file is missing, is no episode, or shows no goal.
    """
    path = Path(path)
    match = _FILE.fullmatch(path.name)
    if match is None:
        raise InputError(f"{path} is not named episode_<9 digits>.parquet like a goal's file")
    return _goal(EpisodeReader(path.parent), int(match[1]))


def at_goal(task: Task) -> Task:
    """The task with every start at the goal that its seed would get; what no longer has a goal."""

    class AtGoal(type(task)):  # type: ignore[misc]
        goal_conditioned = False

        def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
            layout: Layout = self.goal_layout(super().sample(rng, space))
            return layout

        def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
            return False  # solved starts would be drawn again

    made: Task = AtGoal()
    return made


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


def _rest(worlds: Worlds, runs: Mapping[int, Run[Step]]) -> dict[int, np.ndarray | None]:
    """Do nothing."""
    return dict.fromkeys(runs)


def _goal_episode(worlds: Worlds, slot: int, run: Run[Step], task: Task) -> Episode:
    """A slot's state as a goal of the task: one row, at which it is done."""
    made = record(worlds, slot, run, demonstrator=CONSTRUCTED)
    goal = worlds.as_goal(slot, kind=CONSTRUCTED)
    extra = {**origin(task), GOAL_TARGETS: goal.targets.tolist()}
    return Episode(
        info=replace(made.info, success=True, config=task_config(task), extra=extra),
        steps=(replace(made.steps[0], success=True),),
        goal=goal,
    )


def _goal(reader: EpisodeReader, seed: int) -> Goal:
    """What an episode's last row shows, as a goal."""
    info, path = reader.info(seed), reader.path(seed)
    task = recorded_task(info)
    if not task.goal_conditioned:
        raise InputError(f"{path} is an episode of {info.task}, which has no goal image")
    if not info.success:
        raise InputError(f"{path} did not reach its goal, so its last state is none")
    try:
        targets = np.array(info.extra[GOAL_TARGETS], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not say what its last state stands for as a goal, as recordings from "
            "elsewhere may not; `warp-deform goals` makes goals"
        ) from error
    row = reader.read_step(seed, info.actions)
    kind = CONSTRUCTED if info.demonstrator == CONSTRUCTED else _DEMONSTRATED
    return Goal(row.color, row.height, targets, kind, seed)
