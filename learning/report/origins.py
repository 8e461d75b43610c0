"""The runs of a report one by one: where each comes from, and what it came to by itself."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from warp_deform.support.progress import duration
from warp_deform.support.revision import Revision

from .cells import RunResult

__all__ = ["origin", "origins", "runs_csv"]

_HEAD = ["task", "agent", "demos", "variant", "seed", "steps", "training, CPU", "trained by",
         "evaluated by"]  # fmt: skip
_RESULT = ("n_success", "n_episodes", "mean_score", "mean_actions")
"""What is said of the test episodes of one run."""


def origin(run: RunResult) -> dict[str, Any]:
    """One run, as JSON; None where an earlier version did not say.

    trained_by holds every revision of the code that training went on with.
    """
    info, settings = run.info, run.settings
    return {
        "run": str(run.path),
        "task": run.task,
        "environment": info.get("environment"),
        "agent": run.agent,
        "demos": run.demos,
        "variant": run.variant,
        "seed": run.seed,
        "steps": info["trained_steps"],
        "labels": settings.get("labels"),
        "training_cpu_seconds": info.get("training_cpu_seconds") or None,
        **{key: info["test"][key] for key in _RESULT},
        "trained_by": settings.get("revisions"),
        "evaluated_by": info.get("revision"),
    }


def runs_csv(origins_of_runs: Sequence[Mapping[str, Any]]) -> str:
    """A row a run: all that `origin` says but for its folder and revisions."""
    left_out = ("run", "trained_by", "evaluated_by")
    text = io.StringIO()
    names = [name for name in origins_of_runs[0] if name not in left_out]
    writer = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(origins_of_runs)
    return text.getvalue()


def origins(origins_of_runs: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """The rows of a table, its head first, of what `origin` says."""
    rows = [_HEAD]
    for each in origins_of_runs:
        seconds, trained, evaluated = (
            each[key] for key in ("training_cpu_seconds", "trained_by", "evaluated_by")
        )
        keys = ("task", "agent", "demos", "variant", "seed", "steps")
        rows.append(
            [
                *(str(each[key]) for key in keys),
                "-" if seconds is None else duration(seconds),
                "; ".join(map(_said, trained)) if trained else "-",
                _said(evaluated) if evaluated else "-",
            ]
        )
    return rows


def _said(revision: Mapping[str, Any]) -> str:
    return str(Revision(**revision))
