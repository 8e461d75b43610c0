"""The three levels of the check, as rows of one table."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, WarpDeformError
from ..rollout.differentiable import DifferentiableRollout
from ..support.progress import progress_bar
from ..tasks.registry import TASKS
from ..tasks.registry import task as find_task
from ..worlds.worlds import Worlds
from ..xpbd.lanes.tape import Kind
from .actions import ActionSample, compare_actions
from .config import GradcheckConfig
from .differences import PARAMETERS, WORLDS, Sample, compare, fired
from .draws import Draw, draw_states

__all__: list[str] = []  # `warp_deform.gradcheck` is the import path of what is here

BOUNDS = {"substep": 1e-6, "window": 1e-5}
"""Errors that the adjoint is to stay below."""
WITHIN, WITHIN_EACH = 0.99, 0.5
"""Shares of comparisons below their bound that pass: of all, and of those by one parameter. Near a
branch single differences are off by more than they tell, some four in ten thousand."""
WINDOW = 0.1
"""Length of a window [s]."""
ALL = "all"
ENOUGH = 20
"""States in which a kind of constraint acted that a figure rests on."""
MOST_SEARCHED = 2
"""States searched for rare kinds, as a multiple of those that are compared anyway."""
_DTYPE = "float64"
_MEMORY = 3 * 2**29  # bytes


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the report; None where a level does not say.

    Attributes:
        constraint: kind whose states are counted, see `Kind`, or "all"
        parameter: what is differentiated by, or "all"; of actions "place", by the rollout that
            counts, and "place, as differentiated", by the one that is differentiated
        relative_error: 99th percentile over states, see `Sample.error`
        cosine: between all directional derivatives and their differences; of actions the mean
        share: of comparisons that cross no branch; of actions those that a search would use
        growth: median of the gradient's length at the start over that at the end
        n: comparisons, or actions
        states: from so many states
        within: share of the comparisons that count whose error is below the level's bound
        doubtful: share of comparisons that do not count, as the differences themselves are not
            known to the level's bound
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
    states: int
    within: float | None
    doubtful: float | None


def check(name: str | None, config: GradcheckConfig) -> tuple[list[Row], list[str]]:
    """Rows of the task called `name`, or of every task, and notes on what was left out.

    Progress goes to stderr.

    Raises:
        InputError: no such task.
        WarpDeformError: a task's episodes gave fewer states than were asked for.
    """
    rows: list[Row] = []
    notes: list[str] = []
    for each in TASKS if name is None else [name]:
        rows += _check_task(each, config, notes)
    return rows, notes


def wrong(rows: Sequence[Row]) -> list[Row]:
    """Rows over all constraints of which too many comparisons miss their level's bound."""
    return [
        row
        for row in rows
        if row.constraint == ALL and row.within is not None
        and row.within < (WITHIN if row.parameter == ALL else WITHIN_EACH)
    ]  # fmt: skip


def _check_task(name: str, config: GradcheckConfig, notes: list[str]) -> list[Row]:
    task, rows = find_task(name), []
    if "action" in config.levels:
        print(f"{name}: {config.actions} actions", file=sys.stderr)
        try:
            rows += _action_rows(name, compare_actions(task, config.actions, seed=config.seed))
        except InputError as error:
            notes.append(f"{name}: whole actions were left out: {error}")
    for level, count in (("window", config.windows), ("substep", config.states)):
        if level in config.levels:
            worlds = Worlds(task, WORLDS, lanes=1, precision=_DTYPE)
            states = _compare_states(worlds, level, count, config.seed)
            rows = _rows(name, level, states, notes) + rows
    return rows


def _compare_states(worlds: Worlds, level: str, count: int, seed: int) -> list[list[Sample]]:
    """Samples of `count` states; of substeps also of others in which rare kinds act."""
    run = DifferentiableRollout(worlds.solver, storage="full", memory=_MEMORY)
    rng = np.random.default_rng(seed)
    draws = draw_states(worlds, rng, seed=seed, each=max(2, count // 10))
    label = f"{worlds.task.name}: {level}"
    substeps = 1 if level == "substep" else round(WINDOW / worlds.solver.config.dt)
    bound = BOUNDS[level]
    states = []
    for draw in _shown(draws, label, count):
        states.append(compare(run, worlds, draw, substeps, rng, bound=bound))
    if len(states) < count:
        raise WarpDeformError(
            f"{worlds.task.name}: its episodes gave {len(states)} states of {count}; ask for fewer"
        )
    if level == "window":
        return states
    seen = (np.stack([samples[0].fired for samples in states]) > 0).sum(axis=0)
    for draw in _shown(draws, f"{label}, for rare constraints", MOST_SEARCHED * count):
        if (seen >= ENOUGH)[seen > 0].all():
            break
        acted = fired(run, worlds, draw) > 0
        if (acted & (seen < ENOUGH)).any():
            states.append(compare(run, worlds, draw, substeps, rng, bound=bound))
            seen += acted
    return states


def _shown(draws: Iterator[Draw], label: str, count: int) -> Iterator[Draw]:
    """The next `count` draws, with their number on stderr."""
    with progress_bar(label, count, unit="states") as advance:
        for _, draw in zip(range(count), draws, strict=False):
            yield draw
            advance()


def _rows(task: str, level: str, states: Sequence[Sequence[Sample]], notes: list[str]) -> list[Row]:
    """Over all states, and of substeps over those in which constraints of a kind acted."""
    rows = []
    for kind in (None, *Kind) if level == "substep" else (None,):
        acted = [s for s in states if kind is None or s[0].fired[kind] > 0]
        constraint = ALL if kind is None else kind.name.lower()
        if kind is not None and 0 < len(acted) < ENOUGH:
            notes.append(f"{task}: {constraint} acted in {len(acted)} states, fewer than {ENOUGH}")
        for parameter in (*PARAMETERS, ALL):
            part = [[s for s in samples if parameter in (s.parameter, ALL)] for samples in acted]
            part = [samples for samples in part if samples]
            if part:
                rows.append(_row(task, level, constraint, parameter, part))
    return rows


def _row(
    task: str, level: str, constraint: str, parameter: str, states: Sequence[Sequence[Sample]]
) -> Row:
    bound = BOUNDS[level]
    samples = [sample for state in states for sample in state]
    smooth = [s for s in samples if s.doubt is not None]
    known = [s for s in smooth if s.doubt is not None and s.doubt < bound]
    errors = [s.error for s in known]
    return Row(
        task=task,
        level=level,
        constraint=constraint,
        parameter=parameter,
        relative_error=float(np.percentile(errors, 99)) if known else None,
        cosine=_cosine([s.ours for s in known], [s.theirs for s in known]),
        share=len(smooth) / len(samples),
        growth=float(np.median([s[0].growth for s in states]))
        if parameter == "positions"
        else None,
        dtype=_DTYPE,
        n=len(samples),
        states=len(states),
        within=float(np.mean(np.less(errors, bound))) if known else None,
        doubtful=(len(smooth) - len(known)) / len(samples),
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
            states=len(samples),
            within=None,
            doubtful=None,
        )
        for parameter, part in cosines.items()
    ]
