"""Demonstrations of control at a fixed rate: who demonstrates a task, and attempts of seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..control.control_task import ControlTask
from ..control.control_worlds import ControlWorlds
from ..control.episode_problem import EpisodeProblem
from ..control.fold_fabric import FoldFabric1
from ..control.plan_players import CornerPlayer
from ..control.plan_search import optimize
from ..control.registry import control_task
from ..control.swing_problem import SwingProblem
from ..control.tip_demonstrator import TIP_MODES, TipDemonstrator, usual_mode
from ..episodes import EpisodeWriter
from ..errors import InputError
from ..tasks.task import Task
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import SOLVED
from .control_episodes import (
    Act,
    ControlEpisode,
    ControlSetup,
    control_worlds,
    play_control_episodes,
    record_control,
    without_idle_end,
)
from .folder import Attempt, append_attempt
from .recording import task_config
from .settings import CollectSettings

__all__ = [
    "ControlChunk",
    "attempt_control_chunk",
    "check_control",
    "describe_control",
    "has_horizon",
    "replay_acts",
]

SEARCHED = "cem"
"""Who demonstrates what is held from the start: the search of `warp_deform.control.optimize`."""
_SPREAD = 0.5
"""Of how far from its point a corner is laid, whose unit is 5 mm."""
_WORLDS = 32
"""Plans that are simulated side by side in a search; their number changes no bit."""


def check_control(settings: CollectSettings) -> None:
    """Raise InputError unless the task can be demonstrated at a fixed rate as is asked for."""
    task = control_task(settings.task)
    if settings.demonstrator not in ("scripted", "visible"):
        raise InputError(
            f"with --control the demonstrator is scripted or visible, not {settings.demonstrator}"
        )
    if settings.horizon is not None and settings.horizon < 1:
        raise InputError(f"horizon is {settings.horizon}; it must be 1 control step or more")
    if settings.evaluations < 1:
        raise InputError(f"evaluations is {settings.evaluations}; it must be 1 or more")
    who = _demonstrates(task)
    if who is not None:
        fixed = {"control_mode": (None, TIP_MODES[0]), "horizon": (None,), "start": ("free",)}
        for name, allowed in fixed.items():
            if getattr(settings, name) not in allowed:
                flag = name.replace("_", "-")
                raise InputError(f"{who} {task.name}; there is no choice of --{flag}")
        if settings.demonstrator != "scripted":
            raise InputError(f"{who} {task.name}, and nobody else")


def has_horizon(task: str) -> bool:
    """Whether demonstrations of a task may be given more control steps."""
    return _demonstrates(control_task(task)) is None


def describe_control(settings: CollectSettings) -> dict[str, Any]:
    """What all episodes of a collection have in common, beyond task, robot and seed."""
    how, task = _setup(settings), control_task(settings.task)
    return {
        "mode": how.control_mode,
        "start": how.start,
        "horizon": how.horizon,
        "pictures": settings.pictures,
        "config": task_config(task),
        **({"evaluations": settings.evaluations} if _is_searched(task) else {}),
    }


@dataclass(frozen=True)
class ControlChunk:
    """Seeds for one process."""

    settings: CollectSettings
    out: Path
    seeds: tuple[int, ...]


def attempt_control_chunk(chunk: ControlChunk) -> Iterator[Attempt]:
    """Attempt seeds; a success is a file, and every attempt a line of the ledger, at once."""
    settings = chunk.settings
    writer = EpisodeWriter(chunk.out, overwrite=True)  # by the same episode, if at all
    how = _setup(settings)
    control = control_worlds(how)
    start, act, name = _demonstrator(control, settings)
    played = play_control_episodes(
        control, chunk.seeds, start=start, act=act, pictures=settings.pictures
    )
    for slot, run in played:
        success = run.ended == SOLVED
        if success:
            kept = without_idle_end(run)
            writer.write(
                record_control(control, slot, kept, demonstrator=name, pictures=settings.pictures)
            )
        score = run.rows[-1].score if run.rows else 0.0
        attempt = Attempt(run.seed, success, len(run.actions), score, run.ended or "")
        append_attempt(chunk.out, attempt)
        yield attempt


def _setup(settings: CollectSettings) -> ControlSetup:
    task = control_task(settings.task)
    mode = settings.control_mode or usual_mode(task)
    return ControlSetup(
        type(task), settings.robot, mode, start=settings.start, horizon=settings.horizon
    )


def _is_searched(task: Task) -> bool:
    """Whether something is held from the start, so that no pick demonstrates it."""
    return isinstance(task, ControlTask) and (task.held_particle, task.held_body) != (None, None)


def _demonstrates(task: Task) -> str | None:
    """Who demonstrates a task by itself, as messages say it; None: a demonstrator by its name."""
    if _is_searched(task):
        return "a search demonstrates"
    carried = isinstance(task, FoldFabric1) and task.carries
    return "carries of corners demonstrate" if carried else None


def _demonstrator(
    control: ControlWorlds, settings: CollectSettings
) -> tuple[Callable[[Mapping[int, ControlEpisode]], None], Act, str]:
    """What is done at the start of episodes, who acts in them, and the name of that."""
    if _is_searched(control.task):
        plans = _Plans(settings)
        return plans.start, plans.act, SEARCHED
    if isinstance(control.task, FoldFabric1) and control.task.carries:
        carries = _Carries(control, control.task)
        return carries.start, carries.act, settings.demonstrator
    tips = TipDemonstrator(control, settings.demonstrator)
    return (
        lambda runs: tips.start(list(runs)),
        lambda runs: tips.act(list(runs)),
        settings.demonstrator,
    )


class _Carries:
    """Carries corners of a fabric to about their places, by numbers that are drawn by the seed.

    A straight pick and place, as of other demonstrators, leaves a fold's vertices 3 cm from theirs.
    """

    def __init__(self, control: ControlWorlds, task: FoldFabric1) -> None:
        self._control, self._task = control, task
        self._players: dict[int, CornerPlayer] = {}

    def start(self, runs: Mapping[int, ControlEpisode]) -> None:
        task = self._task
        for slot, run in runs.items():
            player = CornerPlayer(task.control, task.fabric.columns, task.carries)
            rng = episode_rng(run.seed, DEMONSTRATOR_STREAM)
            layout = self._control.worlds.episodes[slot].layout
            numbers = rng.normal(0.0, _SPREAD, (1, *player.shape))
            numbers[..., 0] = 0.0  # always the corner that is farthest from its place
            player.begin(numbers, [layout])
            self._players[slot] = player

    def act(self, runs: Mapping[int, ControlEpisode]) -> dict[int, np.ndarray | None]:
        worlds, targets = self._control.worlds, self._control.targets
        rows: dict[int, np.ndarray | None] = {}
        for slot, run in runs.items():
            tip, particle_q = targets.asked[slot, :3], worlds.solver.particle_q(slot)
            row = self._players[slot].rows(len(run.actions), tip[None], particle_q[None])[0]
            rows[slot] = np.clip(row, -1.0, 1.0).astype(np.float32)
        return rows


class _Plans:
    """Searches a plan for every seed, and goes through it.

    Every search is of one goal and by its own seed, so that a plan depends on nothing else.
    """

    def __init__(self, settings: CollectSettings) -> None:
        self._settings = settings
        self._has_boxes = "box" in control_task(settings.task).objects
        self._actions: dict[int, np.ndarray] = {}

    def start(self, runs: Mapping[int, ControlEpisode]) -> None:
        for run in runs.values():
            self._actions[run.seed] = self._found(run.seed)

    def act(self, runs: Mapping[int, ControlEpisode]) -> dict[int, np.ndarray | None]:
        return {slot: self._actions[run.seed][len(run.actions)] for slot, run in runs.items()}

    def _found(self, seed: int) -> np.ndarray:
        task, robot, budget = (
            getattr(self._settings, name) for name in ("task", "robot", "evaluations")
        )
        if not self._has_boxes:
            swing = SwingProblem(task, [seed], worlds=_WORLDS, robot=robot)
            found = optimize(swing, SEARCHED, evaluations=budget, seed=seed)
            return np.asarray(swing.actions(found.numbers[0]), np.float32)
        episode = EpisodeProblem(task, [seed], worlds=_WORLDS, robot=robot)
        found = optimize(episode, SEARCHED, evaluations=budget, seed=seed)
        return np.asarray(episode.play([0], found.numbers).actions[0], np.float32)


def replay_acts(actions: Mapping[int, Sequence[np.ndarray]]) -> Act:
    """Who takes recorded actions (A,), by seed, one after the other; then the episode ends."""

    def act(runs: Mapping[int, ControlEpisode]) -> dict[int, np.ndarray | None]:
        chosen: dict[int, np.ndarray | None] = {}
        for slot, run in runs.items():
            rest = actions[run.seed][len(run.actions) :]
            chosen[slot] = rest[0] if len(rest) else None
        return chosen

    return act
