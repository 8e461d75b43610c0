"""The paper's tables and curves from run folders: what `warp-deform report` writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError

from ..evaluation.paper_results import read_paper
from .cells import environment_notes, pool, version_notes
from .curves import draw_curves
from .origins import origin, runs_csv
from .read import read_runs
from .tables import csv_text, latex_text, markdown_text

__all__ = ["Report", "write_report"]


@dataclass(frozen=True)
class Report:
    """What a report says: as a JSON object, and as Markdown."""

    data: dict[str, Any]
    text: str


def write_report(paths: Sequence[Path], out: Path | None) -> Report:
    """Tables of the evaluated runs in folders; with `out`, files of them and of the curves too.

    The object has `runs`, `cells` (the fields of `Cell`), `origins` (of each run, see
    `origins.origin`), `notes` and `files` (paths).

    Raises:
        InputError: no evaluated run, runs that cannot be told apart, or a folder that cannot be
            made.
    """
    runs, notes = read_runs(paths)
    paper = read_paper()
    cells = pool(runs, paper)
    notes += version_notes(runs) + environment_notes(runs)
    files: list[Path] = []
    made = [origin(run) for run in runs]
    text = markdown_text(cells, paper, notes, made=made)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out} cannot be made: {error.strerror}") from error
        pictures = draw_curves(cells, paper, out)
        texts = {
            "report.md": markdown_text(cells, paper, notes, pictures, made=made),
            "report.csv": csv_text(cells),
            "runs.csv": runs_csv(made),
            "report.tex": latex_text(cells, paper),
        }
        for name, content in texts.items():
            (out / name).write_text(content)
        files = [*(out / name for name in texts), *pictures]
    data = {
        "runs": len(runs),
        "origins": made,
        "cells": [asdict(cell) for cell in cells],
        "notes": notes,
        "files": [str(path) for path in files],
    }
    return Report(data, text)
