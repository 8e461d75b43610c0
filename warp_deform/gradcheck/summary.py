"""One line per task and level, out of the rows of `check`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .report import ALL, ENOUGH, Row

__all__: list[str] = []  # `warp_deform.gradcheck` is the import path of what is here


@dataclass(frozen=True, kw_only=True)
class Summary:
    """One line; None where a level does not say.

    Attributes:
        worst: largest 99th percentile of any constraint and parameter, and which these are
        within: over all comparisons, see `Row`
        share: over all comparisons, see `Row`
        doubtful: over all comparisons, see `Row`
        growth: by positions; of actions by place, in the rollout that counts
        cosine: as `growth`
        states: states, or actions
        seldom: kinds of constraints that acted in fewer than `ENOUGH` states
    """

    task: str
    level: str
    worst: float | None
    constraint: str | None
    parameter: str | None
    within: float | None
    share: float
    doubtful: float | None
    growth: float | None
    cosine: float | None
    states: int
    seldom: tuple[str, ...]


def summarise(rows: Sequence[Row]) -> list[Summary]:
    """In the order of the rows."""
    by_level: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        by_level.setdefault((row.task, row.level), []).append(row)
    return [_summary(part) for part in by_level.values()]


def _summary(rows: Sequence[Row]) -> Summary:
    overall = [row for row in rows if row.constraint == ALL]
    everything = next((row for row in overall if row.parameter == ALL), overall[0])
    worst = max(
        (row for row in rows if row.relative_error is not None and row.parameter != ALL),
        key=lambda row: row.relative_error or 0.0,
        default=None,
    )
    growths = [row.growth for row in overall if row.growth is not None]
    kinds = {row.constraint: row.states for row in rows if row.parameter == ALL}
    return Summary(
        task=everything.task,
        level=everything.level,
        worst=None if worst is None else worst.relative_error,
        constraint=None if worst is None else worst.constraint,
        parameter=None if worst is None else worst.parameter,
        within=everything.within,
        share=everything.share,
        doubtful=everything.doubtful,
        growth=growths[0] if growths else None,
        cosine=everything.cosine,
        states=everything.states,
        seldom=tuple(k for k, states in kinds.items() if k != ALL and states < ENOUGH),
    )
