"""Goals from files: a goal is what the last row of an episode file shows.

A goal is stored as an episode whose last row shows it: a whole demonstration, or a single row. So
every folder of demonstrations is a set of goals too, and one reader serves both.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..episodes import EpisodeReader, Goal
from ..errors import InputError
from ..tasks.free_space import FreeSpace
from ..tasks.registry import task as find_task
from ..tasks.task import Layout, Snapshot, Task
from .recording import GOAL_TARGETS, recorded_task

__all__ = [
    "CONSTRUCTED",
    "DEMONSTRATED",
    "at_goal",
    "check_goals",
    "goals_in_turn",
    "load_goal",
    "load_goals",
]

CONSTRUCTED = "constructed"
"""Kind of goal, and the demonstrator that the files of such goals name."""
DEMONSTRATED = "demonstrated"
"""The other kind: where a demonstration ended."""
_FILE = re.compile(r"episode_(\d{9})\.parquet")


def load_goals(folder: Path) -> list[Goal]:
    """The goals of a folder, in the order of their seeds.

    Raises:
        InputError: the folder is missing or empty, or an episode in it shows no goal.
    """
    reader = EpisodeReader(folder)
    return [_goal(reader, seed) for seed in reader.seeds]


def goals_in_turn(folder: Path | None) -> Callable[[int], Goal | None]:
    """What an episode goes for, by its seed: the folder's goals in turn.

    Without a folder it is None: the seed makes a goal of its own.

    Raises:
        InputError: see `load_goals`.
    """
    goals = [] if folder is None else load_goals(folder)

    def goal(seed: int) -> Goal | None:
        return goals[seed % len(goals)] if goals else None

    return goal


def check_goals(folder: Path, task: str) -> Path:
    """The folder, if it holds goals of the task.

    Raises:
        InputError: it does not, or the task has no goals.
    """
    if not find_task(task).goal_conditioned:
        raise InputError(f"{task} has no goal image, so no goals can be given")
    for info in EpisodeReader(folder).infos():
        if info.task != task:
            raise InputError(f"{folder} holds goals of {info.task}, not of {task}")
    load_goals(folder)
    return folder


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


def _goal(reader: EpisodeReader, seed: int) -> Goal:
    """What an episode's last row shows, as a goal."""
    info, path = reader.info(seed), reader.path(seed)
    task = recorded_task(info)
    if not task.goal_conditioned:
        raise InputError(f"{path} is an episode of {info.task}, which has no goal image")
    if not info.success:
        raise InputError(f"{path} did not reach its goal, so its last state cannot serve as a goal")
    try:
        targets = np.array(info.extra[GOAL_TARGETS], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not say what its last state means as a goal, perhaps because another "
            "program recorded it; `warp-deform goals` makes goals"
        ) from error
    row = reader.read_step(seed, info.actions)
    kind = CONSTRUCTED if info.demonstrator == CONSTRUCTED else DEMONSTRATED
    return Goal(row.color, row.height, targets, kind, seed)
