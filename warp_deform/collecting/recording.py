"""From running worlds to the records of the dataset format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, is_dataclass, replace
from typing import Any, Protocol

import numpy as np

from ..episodes import Episode, EpisodeInfo, Step, combine_hashes, cpu_fingerprint, versions
from ..episodes.enclosed import ENCLOSED
from ..episodes.goals import GOAL_GIVEN
from ..tasks.registry import FURTHER_TASKS, TASKS, task_name
from ..tasks.registry import task as find_task
from ..tasks.task import Task
from ..worlds.loop import SOLVED, EpisodeRun
from ..worlds.worlds import Worlds

__all__ = [
    "GOAL_TARGETS",
    "episode_info",
    "observe",
    "origin",
    "record",
    "recorded_task",
    "task_config",
]

GOAL_TARGETS = "goal_targets"
"""Where an episode of a goal-conditioned task keeps what its last state stands for as a goal."""

_TASK_CLASS = "task_class"
"""Where an episode of a task from elsewhere says which class that was."""


def observe(worlds: Worlds, slot: int, *, images: bool = True) -> Step:
    """The row of a slot's present state; `record` fills in the action.

    Args:
        images: whether they are drawn; without them those of the row are empty
    """
    episode = worlds.episodes[slot]
    snapshot = episode.snapshot
    return Step(
        color=snapshot.images.color if images else np.zeros((0, 0, 3), np.uint8),
        height=snapshot.images.height if images else np.zeros((0, 0), np.float32),
        action=None,
        score=float(worlds.score(slot)),
        success=bool(worlds.solved(slot)),
        physics_ok=episode.physics_ok,
        sim_seconds=float(episode.sim_seconds),
        state_hash=worlds.hash(slot),
        outcome=None,
        particle_q=snapshot.particle_q,
        particle_qd=snapshot.particle_qd,
        body_q=snapshot.body_q,
        body_qd=snapshot.body_qd,
        ground_truth=np.asarray(
            worlds.task.ground_truth(episode.layout, snapshot), dtype=np.float32
        ),
    )


def record(worlds: Worlds, slot: int, run: EpisodeRun[Step], *, demonstrator: str) -> Episode:
    """The episode that has just ended in a slot; `run` holds a row for every state."""
    rows = [
        replace(row, action=action, outcome=outcome)
        for row, action, outcome in zip(run.rows, run.actions, run.outcomes, strict=False)
    ]
    episode = worlds.episodes[slot]
    info = episode_info(
        worlds,
        slot,
        run,
        demonstrator=demonstrator,
        sim_seconds=float(episode.sim_seconds),
        extra={**origin(worlds.task), **_as_goal(worlds, slot), **_enclosed(worlds, slot)},
    )
    return Episode(info, (*rows, run.rows[-1]), episode.goal)


class _Run(Protocol):
    """What every kind of played episode knows, see `EpisodeRun`."""

    seed: int
    ended: str | None

    @property
    def rows(self) -> Sequence[Any]: ...

    @property
    def actions(self) -> Sequence[np.ndarray]: ...


def episode_info(worlds: Worlds, slot: int, run: _Run, **own: Any) -> EpisodeInfo:
    """What is told of the episode that has just ended in a slot, besides its kind's own."""
    episode = worlds.episodes[slot]
    return EpisodeInfo(
        task=worlds.task.name,
        seed=run.seed,
        success=run.ended == SOLVED,
        score=run.rows[-1].score,
        actions=len(run.actions),
        robot=worlds.robot.name,
        state_hash=combine_hashes(row.state_hash for row in run.rows),
        physics_ok=episode.physics_ok,
        discarded_starts=episode.discarded_starts,
        config=task_config(worlds.task),
        versions=versions(),
        cpu=cpu_fingerprint(),
        goal=None,
        **own,
    )


def _as_goal(worlds: Worlds, slot: int) -> dict[str, Any]:
    """Where the task has goals: whether it was given, and what the last state stands for as one."""
    if not worlds.task.goal_conditioned:
        return {}
    targets = worlds.as_goal(slot, kind="demonstrated").targets.tolist()
    return {
        GOAL_TARGETS: targets,
        **({GOAL_GIVEN: True} if worlds.episodes[slot].goal_given else {}),
    }


def origin(task: Task) -> dict[str, Any]:
    """What an episode says of where its task is from: its class, unless that is this package's."""
    return {} if task.name in TASKS | FURTHER_TASKS else {_TASK_CLASS: task_name(type(task))}


def recorded_task(info: EpisodeInfo) -> Task:
    """The task of an episode.

    Raises:
        InputError: there is none of that name here. A task from elsewhere is not imported because
            a file names it: the message says which class to register.
    """
    named = info.extra.get(_TASK_CLASS)
    return find_task(info.task, recorded=named if isinstance(named, str) else None)


def _enclosed(worlds: Worlds, slot: int) -> dict[str, Any]:
    """Whether the bag enclosed its items, where there are any."""
    enclosed = worlds.enclosed(slot)
    return {} if enclosed is None else {ENCLOSED: enclosed}


def task_config(task: Task) -> dict[str, Any]:
    """A task's full configuration as JSON types: every public constant of its class by name."""
    names = sorted({name for cls in type(task).__mro__ for name in vars(cls)})
    return {
        name: _json(value)
        for name in names
        if not name.startswith("_") and _is_constant(value := getattr(type(task), name))
    }


def _is_constant(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_constant, value))
    return isinstance(value, bool | int | float | str) or (
        is_dataclass(value) and not isinstance(value, type)
    )


def _json(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _json(asdict(value))
    if isinstance(value, dict):
        return {key: _json(inner) for key, inner in value.items()}
    if isinstance(value, tuple | list):
        return [_json(inner) for inner in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
