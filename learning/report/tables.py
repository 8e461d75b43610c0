"""A report's tables as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..evaluation.paper_results import SUCCESS, PaperResults
from ..evaluation.summary import FAILURES
from .cells import Cell
from .origins import origins

__all__ = ["Rows", "compared", "csv_text", "details", "failed", "latex_text", "markdown_text"]

Rows = list[list[str]]

_COMPARED = (
    "Ours (the paper's), in %. Ours: the snapshot that was best on validation seeds, on test seeds "
    "of their own. The paper's: {protocol}. Source: {source}."
)
_DETAILS = (
    "Test episodes of all seeds together. Success: share of episodes solved, with the 95 % Wilson "
    "interval. Score: mean of the last states' scores ± standard error, partial credit included. "
    "Paper's measure: what its table shows for the task, success or mean partial score. Paper's "
    "protocol: the same for the best of all snapshots on 20 test episodes themselves, as the paper "
    "has it, which is optimistic; a privileged lift is chosen there by the paper's hidden rule, "
    "which reads the simulator. Paper: its number."
)


_MADE = (
    "CPU time: of the steps alone, on the machine that trained. A dash stands where an earlier "
    "version did not write it down."
)


def markdown_text(
    cells: Sequence[Cell],
    paper: PaperResults,
    notes: Sequence[str],
    pictures: Sequence[Path] = (),
    *,
    made: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The whole report.

    Args:
        made: what `origins.origin` says of every run
    """
    parts = ["# Results"]
    for variant, rows in compared(cells, paper).items():
        parts += [f"## Beside the paper's: {variant}", _markdown(rows)]
    parts.append(_COMPARED.format(protocol=paper.protocol, source=paper.source))
    parts += ["## In detail", _markdown(details(cells)), _DETAILS]
    parts += ["## Failures", _markdown(failed(cells)), "Episodes by the first rule that holds."]
    if made:
        parts += ["## How the runs were made", _markdown(origins(made)), _MADE]
    if pictures:
        parts.append("## Learning curves")
        parts += [f"![{path.stem}]({path.name})" for path in pictures]
    if notes:
        parts += ["## Notes", "\n".join(f"- {note}" for note in notes)]
    return "\n\n".join(parts) + "\n"


def latex_text(cells: Sequence[Cell], paper: PaperResults) -> str:
    """The first two tables as `tabular`s; they need no package."""
    parts = [f"% {_COMPARED.format(protocol=paper.protocol, source=paper.source)}"]
    for variant, rows in compared(cells, paper).items():
        parts += [f"% {variant}", _latex(rows)]
    parts += [f"% {_DETAILS}", _latex(details(cells))]
    return "\n".join(parts) + "\n"


def csv_text(cells: Sequence[Cell]) -> str:
    """A row a cell; percentages where a column says `pc` or `percent`."""
    columns: dict[str, Callable[[Cell], object]] = {
        "task": lambda c: c.task,
        "agent": lambda c: c.agent,
        "demos": lambda c: c.demos,
        "variant": lambda c: c.variant,
        "seeds": lambda c: " ".join(map(str, c.seeds)),
        "n_episodes": lambda c: c.n_episodes,
        "n_success": lambda c: c.n_success,
        "n_success_enclosed": lambda c: c.n_success_enclosed,
        "pc_success": lambda c: c.pc_success,
        "pc_success_low95": lambda c: c.pc_success_ci95[0],
        "pc_success_high95": lambda c: c.pc_success_ci95[1],
        "mean_score": lambda c: c.mean_score,
        "mean_score_standard_error": lambda c: c.standard_error,
        "mean_actions": lambda c: c.mean_actions,
        "table_measure": lambda c: c.measure,
        "table_percent": lambda c: c.value,
        "table_percent_standard_error": lambda c: c.value_error,
        "paper_protocol_percent": lambda c: c.paper_protocol,
        "paper_protocol_runs": lambda c: c.paper_protocol_runs,
        "paper_protocol_stage_rule": lambda c: c.paper_protocol_stage_rule,
        "paper_percent": lambda c: c.paper,
        **{f"failures_{name.replace(' ', '_')}": _count(name) for name in FAILURES},
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for cell in cells:
        values = (column(cell) for column in columns.values())
        writer.writerow("" if each is None else each for each in values)
    return text.getvalue()


def compared(cells: Sequence[Cell], paper: PaperResults) -> dict[str, Rows]:
    """Tasks and agents by numbers of demonstrations, a table a variant."""
    tables = {}
    for variant in dict.fromkeys(cell.variant for cell in cells):
        mine = {(c.task, c.agent, c.demos): c.value for c in cells if c.variant == variant}
        demos = sorted({*paper.demos, *(n for _, _, n in mine)})
        rows = [["task", "agent", "measure", *map(str, demos)]]
        for task in dict.fromkeys(name for name, _, _ in mine):
            agents = dict.fromkeys([*paper.agents(task), *(a for t, a, _ in mine if t == task)])
            for agent in agents:
                keys = [(task, agent, n) for n in demos]
                both = [_beside(mine.get(key), paper.values.get(key)) for key in keys]
                rows.append([task, agent, paper.measures.get(task, SUCCESS), *both])
        tables[variant] = rows
    return tables


def details(cells: Sequence[Cell]) -> Rows:
    """Everything about every cell."""
    rows = [["task", "agent", "demos", "variant", "seeds", "solved", "enclosed", "success %",
             "95 %", "score", "actions", "paper's measure %", "paper's protocol %",
             "paper %"]]  # fmt: skip
    for c in cells:
        error = "" if c.standard_error is None else f" ± {c.standard_error:.3f}"
        low, high = c.pc_success_ci95
        rows.append(
            [
                c.task,
                c.agent,
                str(c.demos),
                c.variant,
                " ".join(map(str, c.seeds)),
                f"{c.n_success}/{c.n_episodes}",
                "" if c.n_success_enclosed is None else str(c.n_success_enclosed),
                f"{c.pc_success:.1f}",
                f"{low:.1f}-{high:.1f}",
                f"{c.mean_score:.3f}{error}",
                f"{c.mean_actions:.2f}",
                f"{c.value:.1f} ({c.measure})",
                _by_paper(c),
                _number(c.paper),
            ]
        )
    return rows


def failed(cells: Sequence[Cell]) -> Rows:
    """How often every kind of failure happened."""
    rows = [["task", "agent", "demos", "variant", "failed", *FAILURES]]
    for c in cells:
        total = str(c.n_episodes - c.n_success)
        counts = [str(c.failures.get(name, 0)) for name in FAILURES]
        rows.append([c.task, c.agent, str(c.demos), c.variant, total, *counts])
    return rows


def _count(name: str) -> Callable[[Cell], object]:
    return lambda cell: cell.failures.get(name, 0)


def _beside(ours: float | None, theirs: float | None) -> str:
    if ours is None and theirs is None:
        return "-"
    return _number(ours) + ("" if theirs is None else f" ({theirs:.1f})")


def _by_paper(cell: Cell) -> str:
    """The result by the paper's protocol, with who chose the lift unless the policy did."""
    rule = cell.paper_protocol_stage_rule
    label = "" if rule in (None, "action") else f" ({rule} lift)"
    return _number(cell.paper_protocol) + label


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _markdown(rows: Rows) -> str:
    head, *body = rows
    ruler = ["---"] * len(head)
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ruler, *body])


def _latex(rows: Rows) -> str:
    head, *body = rows
    lines = [" & ".join(map(_escape, row)) + r" \\" for row in (head, *body)]
    begin, end = rf"\begin{{tabular}}{{{'l' * len(head)}}}", r"\end{tabular}"
    return "\n".join([begin, r"\hline", lines[0], r"\hline", *lines[1:], r"\hline", end])


def _escape(text: str) -> str:
    for character in "&%_#":
        text = text.replace(character, "\\" + character)
    return text.replace("±", r"$\pm$")
