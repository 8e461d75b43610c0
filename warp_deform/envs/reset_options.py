"""What `reset(seed=..., options=...)` takes: seeds of episodes, and goals from memory or files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..episodes import EpisodeReader, Goal
from ..errors import InputError
from ..rendering.pixels import SHAPE
from ..tasks.free_space import FreeSpace
from ..tasks.task import Task

__all__ = ["IGNORED", "check_options", "goal_for", "next_seed", "single_start"]

GoalOption = Goal | str | os.PathLike[str]

IGNORED = ("lerobot_new_rollout",)
"""Options by which others tell what changes nothing here."""

_UNNAMED = (1_000_000, 1_000_000_000)
"""Range of the seeds of episodes that were started without one: clear of every published split."""


def next_seed(rng: np.random.Generator) -> int:
    """Seed of an episode that the user gave none: the same sequence for the same generator."""
    return int(rng.integers(*_UNNAMED))


def check_options(options: Mapping[str, Any] | None, *known: str) -> Mapping[str, Any]:
    """The options, {} for None; InputError if there is one that nothing here understands."""
    for name in options or {}:
        if name not in known:
            ours = ", ".join(option for option in known if option not in IGNORED)
            raise InputError(f"reset has no option {name!r}; it has {ours}")
    return options or {}


def single_start(
    task: Task, seed: int | None, options: Mapping[str, Any] | None, rng: np.random.Generator
) -> tuple[int, dict[int, Goal]]:
    """The seed of an environment's next episode, and the goal by slot if one was given.

    Raises:
        InputError: an option is unknown, or the goal is not this task's.
    """
    number = int(seed) if seed is not None else next_seed(rng)
    given = check_options(options, "goal", *IGNORED).get("goal")
    return number, {} if given is None else {0: goal_for(task, given, seed=number)}


def goal_for(task: Task, given: GoalOption, *, seed: int) -> Goal:
    """The goal that an episode with this seed is given.

    Args:
        given: a goal; an episode file, whose last state is the goal; or a folder of them, of which
            the one number `seed` modulo their count is taken, so seeds 10,000 to 10,019 go through
            20 goals

    Raises:
        InputError: the task takes no goal, or this one is another task's.
    """
    if not task.goal_conditioned:
        raise InputError(f"{task.name} is no goal-conditioned task; leave out the option goal")
    if isinstance(given, Goal):
        goal = given
    elif isinstance(given, str | os.PathLike):
        goal = _read(task, Path(given), seed)
    else:
        raise InputError(f"a goal is a Goal or a path, not {type(given).__name__}")
    wanted = task.sample(np.random.default_rng(0), FreeSpace()).targets.shape
    if np.shape(goal.targets) != wanted or not np.isfinite(goal.targets).all():
        raise InputError(
            f"a goal of {task.name} has finite targets {wanted}, got shape {np.shape(goal.targets)}"
        )
    if goal.color.shape != (*SHAPE, 3) or goal.height.shape != SHAPE:
        raise InputError(f"goal images must be {SHAPE[0]} x {SHAPE[1]}, got {goal.color.shape[:2]}")
    return goal


def _read(task: Task, path: Path, seed: int) -> Goal:
    """The goal that an episode on disk shows."""
    from ..collecting.goals import load_goal  # with what makes goals, it is only needed for files

    if not path.exists():
        raise InputError(f"no goal at {path}; `warp-deform goals` makes a folder of them")
    if path.is_dir():
        reader = EpisodeReader(path)
        path = reader.path(reader.seeds[seed % len(reader)])
    goal = load_goal(path)
    made = EpisodeReader(path.parent).info(goal.seed).task
    if made != task.name:
        raise InputError(f"{path} holds a goal of {made}, not of {task.name}")
    return goal
