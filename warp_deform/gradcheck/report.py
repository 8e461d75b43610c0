"""The three levels of the check, as rows of one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..differentiable import DifferentiableRollout
from ..errors import InputError, WarpDeformError
from ..solver.tape import Kind
from ..tasks.registry import TASKS
from ..tasks.registry import task as find_task
from ..worlds import Worlds
from .actions import ActionSample, compare_actions
from .differences import PARAMETERS, WORLDS, Sample, compare
from .draws import draw_states

__all__: list[str] = []  # `warp_deform.gradcheck` is the import path of what is here

LEVELS = ("substep", "window", "action")
WINDOW = 0.1
"""Length of a window [s]."""
ALL = "all"
_DTYPE = "float64"
_MEMORY = 2**29  # bytes


@dataclass(frozen=True, kw_only=True)
class GradcheckConfig:
    """What is checked, and how much of it."""

    levels: tuple[str, ...] = LEVELS
    states: int = 200
    """States whose next substep is differentiated."""
    windows: int = 30
    """States from which a window is differentiated."""
    actions: int = 16
    """Whole actions that are differentiated."""
    seed: int = 0
    """First episode, and the random directions."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the report; None where a level does not say.

    constraint: kind whose states are counted, see `Kind`, or "all"
    parameter: what is differentiated by; of actions "place", by the rollout that counts, and
    "place, as differentiated", by the one that slopes are taken of
    relative_error: 99th percentile over directions; relative to the larger of the gradient's
    length and `FLOORS`
    cosine: between all directional derivatives and their differences; of actions the mean
    share: of comparisons that cross no branch; of actions those that a search would use
    growth: median of the gradient's length at the start over that at the end
    n: comparisons, or actions
    """

    task: str
    level: str
    constraint: str
    parameter: str
    relative_error: float | None
    cosine: float | None
    share: float
    growth: float | None
    dtype: str
    n: int


def check(name: str | None, config: GradcheckConfig) -> tuple[list[Row], list[str]]:
    """Rows of the task called `name`, or of every task, and notes on what was left out.

    Raises:
        InputError: no such task, or it moves what has no derivatives.
        WarpDeformError: a task's episodes gave fewer states than were asked for.
    """
    rows: list[Row] = []
    notes: list[str] = []
    for each in TASKS if name is None else [name]:
        try:
            rows += _check_task(each, config, notes)
        except InputError as error:
            if name is not None:
                raise
            notes.append(str(error))
    return rows, notes


def _check_task(name: str, config: GradcheckConfig, notes: list[str]) -> list[Row]:
    task, rows = find_task(name), []
    worlds = Worlds(task, WORLDS, lanes=1, precision=_DTYPE)
    try:
        run = DifferentiableRollout(worlds.solver, memory=_MEMORY)
    except InputError as error:
        raise InputError(f"{name} has no derivatives to check: {error}") from error
    if "substep" in config.levels:
        samples = _samples(worlds, run, config.states, worlds.solver.config.dt, config.seed)
        rows += _substep_rows(name, samples)
    if "window" in config.levels:
        samples = _samples(worlds, run, config.windows, WINDOW, config.seed)
        rows += [_row(name, "window", ALL, p, part) for p, part in _by_parameter(samples).items()]
    if "action" in config.levels:
        try:
            rows += _action_rows(name, compare_actions(task, config.actions, seed=config.seed))
        except InputError as error:
            notes.append(f"{name}: whole actions were left out: {error}")
    return rows


def _samples(
    worlds: Worlds, run: DifferentiableRollout, count: int, seconds: float, seed: int
) -> list[Sample]:
    rng = np.random.default_rng(seed)
    samples: list[Sample] = []
    states = 0
    for draw in draw_states(worlds, count, rng, seed=seed):
        samples += compare(run, worlds, draw, seconds, rng)
        states += 1
    if states < count:
        raise WarpDeformError(f"{worlds.task.name}: its episodes gave {states} states of {count}")
    return samples


def _by_parameter(samples: Sequence[Sample]) -> dict[str, list[Sample]]:
    """Samples of every parameter that has any."""
    parts = {p: [s for s in samples if s.parameter == p] for p in PARAMETERS}
    return {p: part for p, part in parts.items() if part}


def _substep_rows(task: str, samples: Sequence[Sample]) -> list[Row]:
    """Over all states, then over those in which constraints of a kind acted."""
    rows = []
    for kind in (None, *Kind):
        acted = [s for s in samples if kind is None or s.fired[kind] > 0]
        constraint = ALL if kind is None else kind.name.lower()
        for parameter, part in _by_parameter(acted).items():
            rows.append(_row(task, "substep", constraint, parameter, part))
    return rows


def _row(task: str, level: str, constraint: str, parameter: str, samples: Sequence[Sample]) -> Row:
    smooth = [s for s in samples if s.smooth]
    grown = parameter == "positions"
    return Row(
        task=task,
        level=level,
        constraint=constraint,
        parameter=parameter,
        relative_error=float(np.percentile([s.error for s in smooth], 99)) if smooth else None,
        cosine=_cosine([s.ours for s in smooth], [s.theirs for s in smooth]),
        share=len(smooth) / len(samples),
        growth=float(np.median([s.growth for s in samples])) if grown else None,
        dtype=_DTYPE,
        n=len(samples),
    )


def _cosine(ours: Sequence[float], theirs: Sequence[float]) -> float | None:
    lengths = float(np.linalg.norm(ours) * np.linalg.norm(theirs))
    return float(np.dot(ours, theirs)) / lengths if lengths > 0 else None


def _action_rows(task: str, samples: Sequence[ActionSample]) -> list[Row]:
    if not samples:
        return []
    growths = [s.growth for s in samples if np.isfinite(s.growth)]
    cosines = {
        "place": [s.cosine_real for s in samples],
        "place, as differentiated": [s.cosine_same for s in samples],
    }
    return [
        Row(
            task=task,
            level="action",
            constraint=ALL,
            parameter=parameter,
            relative_error=None,
            cosine=float(np.mean(known)) if (known := [c for c in part if c is not None]) else None,
            share=float(np.mean([s.usable for s in samples])),
            growth=float(np.median(growths)) if growths else None,
            dtype="float32",
            n=len(samples),
        )
        for parameter, part in cosines.items()
    ]
