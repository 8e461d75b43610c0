"""Recorded control at a fixed rate, simulated again from seeds and actions, and compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..control.registry import CONTROL_TASKS, control_task
from ..episodes import EpisodeInfo, EpisodeReader, Step
from ..errors import InputError
from ..tasks.task import Task
from .control_demos import replay_acts
from .control_episodes import ControlSetup, control_worlds, play_control_episodes
from .recording import recorded_task

__all__ = ["ReplayedControl", "compare_control_chunk", "setup_of"]


@dataclass(frozen=True)
class ReplayedControl:
    """Seeds of a folder, all led in the same way, for one process."""

    folder: Path
    how: ControlSetup
    seeds: tuple[int, ...]
    tolerance: float | None


def setup_of(info: EpisodeInfo) -> ControlSetup:
    """How the tip of a recorded episode was led.

    Raises:
        InputError: the task is not known here, or is not led so.
    """
    record = info.control
    if record is None:
        raise InputError("this is no episode of control at a fixed rate")
    task: Task = control_task(info.task) if info.task in CONTROL_TASKS else recorded_task(info)
    return ControlSetup.of(task, info.robot, record)


def compare_control_chunk(chunk: ReplayedControl) -> Iterator[tuple[int, int, float]]:
    """Number of rows, of differing rows, and the largest distance [m], for every episode.

    A row is compared by the hash of its state, its score, success, reward, and the tip's place.
    """
    reader = EpisodeReader(chunk.folder, control=True)
    episodes = {seed: reader.read(seed) for seed in chunk.seeds}
    actions = {
        seed: [step.action for step in episode.steps if step.action is not None]
        for seed, episode in episodes.items()
    }
    control, act = control_worlds(chunk.how), replay_acts(actions)
    runs = play_control_episodes(
        control, chunk.seeds, start=lambda runs: None, act=act, to_the_end=True
    )
    for _, run in runs:
        steps = episodes.pop(run.seed).steps
        wrong, largest = len(steps) - len(run.rows), 0.0
        for step, seen in zip(steps, run.rows, strict=False):
            error = _distance(step, seen)
            same = _compared(step) == _compared(seen)
            wrong += not same if chunk.tolerance is None else not error <= chunk.tolerance
            largest = max(largest, error)
        yield len(steps), wrong, largest


def _compared(step: Step) -> tuple[object, ...]:
    tip = step.control
    assert tip is not None, "rows of control have a tip"
    return step.state_hash, step.score, step.success, tip.reward, tip.holding, tip.tip.tobytes()


def _distance(step: Step, seen: Step) -> float:
    """Largest distance [m] between a recorded and a replayed position."""
    points = [np.concatenate([row.particle_q, row.body_q[:, :3]]) for row in (step, seen)]
    if points[0].shape != points[1].shape:
        raise InputError(
            f"the recording has {len(points[0])} particles and bodies, this version's task "
            f"{len(points[1])}; replay it with the version that recorded it"
        )
    return float(np.linalg.norm(points[0] - points[1], axis=1).max(initial=0.0))
