"""The script that fills the table of all tasks."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import table

from learning.evaluation.paper_results import read_paper


def test_the_table_has_the_papers_cells(tmp_path: Path) -> None:
    paper = read_paper()
    assert set(table.TASKS) == {task for task, _, _ in paper.values}
    agents = sorted({agent for _, agent, _ in paper.values})
    cells = table.missing(table.TASKS, agents, paper.demos, (0,), tmp_path)
    assert sorted(cells) == sorted((*key, 0) for key in paper.values)


def test_a_cell_is_filled_once_and_then_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--tasks", "block-notarget", "--agents", "gt-mlp", "--demos", "1", "2"]
    arguments += ["--steps", "4", "--episodes", "1", "--work", str(tmp_path / "work")]
    arguments += ["--out", str(tmp_path / "out")]
    elsewhere, here = (
        tmp_path / "out" / "runs" / f"block-notarget-gt-mlp-{n}-0-4-steps" for n in (1, 2)
    )

    def left() -> list[str]:
        capsys.readouterr()
        monkeypatch.setattr(sys, "argv", ["table.py", *arguments, "--list"])
        table.main()
        return capsys.readouterr().out.split()

    assert left() == ["block-notarget-gt-mlp-1-0", "block-notarget-gt-mlp-2-0"]
    elsewhere.mkdir(parents=True)
    monkeypatch.setattr(sys, "argv", ["table.py", *arguments])
    table.main()
    assert {"eval_info.json", "episodes.csv", "run.json"} <= {path.name for path in here.iterdir()}
    assert not any(elsewhere.iterdir()), "nothing is trained for it again"
    assert left() == []
