"""Learning curves as PNG: against steps of training, and against numbers of demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..evaluation.paper_results import PaperResults
from .cells import Cell, CurvePoint

__all__ = ["draw_curves"]

_SIZE, _DPI = (6.4, 3.8), 130
_LEGEND_ROW = 0.17
"""What a row of the legend adds to the height [inch]."""
_MARKERS = "os^Dv<>"

_Draw = Callable[[Axes, Sequence[Cell], PaperResults], None]


def draw_curves(cells: Sequence[Cell], paper: PaperResults, folder: Path) -> list[Path]:
    """Write two PNGs a task, `steps_TASK.png` and `demonstrations_TASK.png`; returns their paths.

    An agent, or a variant of it, has its colour; against steps, a number of demonstrations has its
    marker. Bands and bars are one standard error. Step 0 is the untrained network, where a run
    kept it.
    """
    paths = []
    for task in dict.fromkeys(cell.task for cell in cells):
        mine = [cell for cell in cells if cell.task == task]
        for name, draw in (("steps", _draw_steps), ("demonstrations", _draw_demonstrations)):
            path = folder / f"{name}_{task}.png"
            _drawn(draw, mine, paper).savefig(path, metadata={"Software": None})
            paths.append(path)
    return paths


def _drawn(draw: _Draw, cells: Sequence[Cell], paper: PaperResults) -> Figure:
    """A figure of one task's cells; the legend below the axes, which have no room for many."""
    figure = Figure(_SIZE, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw(axes, cells, paper)
    axes.set_title(cells[0].task)
    axes.set_ylabel(f"{cells[0].measure} [%]")
    axes.set_ylim(-3, 103)
    axes.grid(alpha=0.3)
    _, labels = axes.get_legend_handles_labels()
    figure.set_figheight(_SIZE[1] + _LEGEND_ROW * len(labels))
    figure.legend(fontsize="x-small", loc="outside lower center")
    return figure


def _draw_steps(axes: Axes, cells: Sequence[Cell], paper: PaperResults) -> None:
    axes.set_xlabel("steps of training")
    kinds = list(dict.fromkeys((cell.agent, cell.variant) for cell in cells))
    counts = sorted({cell.demos for cell in cells})
    for cell in cells:
        color = f"C{kinds.index((cell.agent, cell.variant)) % 10}"
        marker = _MARKERS[counts.index(cell.demos) % len(_MARKERS)]
        name = f"{_name(cell, cells)}, {cell.demos} demos"
        _band(axes, cell.validation, color, f"{name}: validation", style="-", marker=marker)
        if len(cell.test) > 1:
            privileged = cell.paper_protocol_stage_rule == "privileged"
            rule = "paper's protocol" + (", privileged lift" if privileged else "")
            _band(axes, cell.test, color, f"{name}: {rule}", style="--", marker=marker)


def _band(
    axes: Axes, points: Sequence[CurvePoint], color: str, label: str, *, style: str, marker: str
) -> None:
    steps = [p.step for p in points]
    values = np.array([p.value for p in points])
    errors = np.array([0.0 if p.error is None else p.error for p in points])
    axes.plot(steps, values, style, marker=marker, ms=4, color=color, label=label)
    axes.fill_between(steps, values - errors, values + errors, color=color, alpha=0.12, lw=0)


def _draw_demonstrations(axes: Axes, cells: Sequence[Cell], paper: PaperResults) -> None:
    axes.set_xlabel("demonstrations")
    axes.set_xscale("log")
    agents = list(dict.fromkeys(cell.agent for cell in cells))
    variants = list(dict.fromkeys(cell.variant for cell in cells))
    for color, agent in enumerate(agents):
        for marker, variant in zip(cycle(_MARKERS), variants, strict=False):
            mine = [cell for cell in cells if (cell.agent, cell.variant) == (agent, variant)]
            if mine:
                axes.errorbar(
                    [cell.demos for cell in mine],
                    [cell.value for cell in mine],
                    yerr=[cell.value_error or 0.0 for cell in mine],
                    marker=marker,
                    ms=4,
                    capsize=3,
                    color=f"C{color}",
                    label=f"{_name(mine[0], cells)}: test",
                )
        keys = [(cells[0].task, agent, n) for n in paper.demos]
        theirs = [(key[2], paper.values[key]) for key in keys if key in paper.values]
        if theirs:
            style = {"marker": "x", "ms": 5, "lw": 1, "color": f"C{color}"}
            axes.plot(*zip(*theirs, strict=True), ":", label=f"{agent}: paper", **style)


def _name(cell: Cell, cells: Sequence[Cell]) -> str:
    """The agent, with the variant where there are several."""
    several = len({each.variant for each in cells}) > 1
    return f"{cell.agent} ({cell.variant})" if several else cell.agent
