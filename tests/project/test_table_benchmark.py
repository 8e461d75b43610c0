"""The script that fills the table of all tasks."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import table

from learning.evaluation.paper_results import read_paper
from learning.runs.folder import RunFolder, write_json


def test_the_table_has_the_papers_cells(tmp_path: Path) -> None:
    paper = read_paper()
    assert set(table.TASKS) == {task for task, _, _ in paper.values}
    agents = sorted({agent for _, agent, _ in paper.values})
    cells = table.missing(table.TASKS, agents, paper.demos, (0,), tmp_path)
    assert sorted(cells) == sorted((*key, 0) for key in paper.values)


def test_a_cell_is_filled_once_and_again_when_its_task_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--tasks", "block-notarget", "--agents", "gt-mlp", "--steps", "4"]
    arguments += ["--episodes", "1", "--work", str(tmp_path / "work"), "--out", str(tmp_path)]
    cell = RunFolder(tmp_path / "runs" / "block-notarget-gt-mlp-2-0-4-steps")

    def left() -> list[str]:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["table.py", *arguments, "--demos", "1", "2", "--list"])
        table.main()
        return capsys.readouterr().out.split()

    assert left() == ["block-notarget-gt-mlp-1-0", "block-notarget-gt-mlp-2-0"]
    monkeypatch.setattr(sys, "argv", ["table.py", *arguments, "--demos", "2"])
    table.main()
    assert {"eval_info.json", "episodes.csv", "run.json"} <= {p.name for p in cell.path.iterdir()}
    assert left() == ["block-notarget-gt-mlp-1-0"]
    write_json(cell.report, cell.read_report() | {"environment": "WarpDeform/BlockNotarget-v0"})
    assert left() == ["block-notarget-gt-mlp-1-0", "block-notarget-gt-mlp-2-0"]
