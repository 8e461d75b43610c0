"""The scripts that measure who should demonstrate, and what a distillation comes to."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest
from fixtures.places import ROOT
from fixtures.training_samples import write_demonstrations

sys.path.insert(0, str(ROOT / "benchmarks"))

import distill
import refine_then_train as benchmark

from warp_deform.collecting.inspection import statistics


def test_ways_start_alike_and_differ_in_their_actions(tmp_path: Path) -> None:
    folders = {
        way: benchmark.demonstrate("cable-ring", way, 1, tmp_path)
        for way in ("scripted", "cem", "mpc")
    }
    shown = {way: statistics(folder) for way, folder in folders.items()}
    assert {way: list(each["demonstrators"]) for way, each in shown.items()} == {
        "scripted": ["scripted"], "cem": ["refined"], "mpc": ["mpc"],
    }  # fmt: skip
    assert shown["cem"]["steps"] < shown["scripted"]["steps"]
    picks = benchmark.picks_of(folders["scripted"])  # the farthest bead, onto its own mark
    assert picks["actions"] == shown["scripted"]["steps"]
    assert picks["farther"] < 0.15 and picks["place_mm"] < 25
    assert {path.name for folder in folders.values() for path in folder.glob("*.parquet")} == {
        "episode_000000000.parquet"
    }


def test_cells_have_one_line_each_and_no_gradient_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "rows.jsonl"
    cells = [(task, way, 10, 0) for task in benchmark.TASKS for way in benchmark.WAYS]
    left = benchmark.missing(cells, 1000, out)
    assert ("cable-ring", "gradient", 10, 0) in left
    assert ("bag-items-1", "mpc", 10, 0) in left and len(left) >= len(cells) - 1
    grids: list[Any] = []

    def swept(grid: Any, **_: object) -> dict[str, Any]:
        grids.append(grid)
        return {"failed": [{"run": "x", "error": "y"}] if len(grids) == 1 else []}

    test = {"n_success": 3, "n_episodes": 4, "mean_score": 0.7, "standard_error": 0.1,
            "n_success_enclosed": None, "paper_value": 75.0, "mean_actions": 5.0}  # fmt: skip
    run = Namespace(agent="transporter", info={"test": test, "training_cpu_seconds": 1.0})
    demos = write_demonstrations(tmp_path / "demos" / "cable-ring", 2)
    monkeypatch.setattr(benchmark, "demonstrate", lambda *_: demos)
    monkeypatch.setattr(benchmark, "run_sweep", swept)
    monkeypatch.setattr(benchmark, "read_runs", lambda _: ([run], []))
    options = Namespace(work=tmp_path / "work", out=out, steps=7, episodes=None)
    cell = ("cable-ring", "mpc", 2, 0)
    assert not benchmark.fill(cell, options) and not out.exists()
    assert benchmark.fill(cell, options)
    (row,) = map(json.loads, out.read_text().splitlines())
    assert (row["way"], row["labels"], row["n_success"], row["value"]) == ("mpc", 4, 3, 75.0)
    assert benchmark.missing([cell], 7, out) == [] and benchmark.missing([cell], 8, out) == [cell]
    (training,) = grids[1].cells()
    assert training.data == demos and (training.steps, training.snapshots) == (7, 1)
    assert grids[1].evaluation.episodes == 200


def test_demonstrations_have_a_cost(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "costs.jsonl"
    arguments = ["--costs", str(out), "--tasks", "cable-ring", "--ways", "scripted", "mpc"]
    monkeypatch.setattr(sys, "argv", ["refine_then_train.py", *arguments, "--demos", "2"])
    benchmark.main()
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["way"], row["demos"]) for row in rows] == [("scripted", 2), ("mpc", 2)]
    assert rows[1]["cpu_s"] > 1.5 * rows[0]["cpu_s"] > 0


def test_a_distillation_is_a_row_once(trained: Path, tmp_path: Path) -> None:
    def stage(name: str, **more: object) -> dict[str, Any]:
        return {"stage": name, "cpu_seconds": 60.0, **more}

    report = {
        "task": "t", "agent": "a", "teacher": "mpc", "seed": 0, "minutes": 5, "cpu_minutes": 6.0,
        "test_cpu_minutes": 1.0, "demos": 2, "corrected": 3, "labels": 30, "run": str(trained),
        "plan": {"round_steps": [7], "last_steps": 9},
        "test": {"n_success": 1, "n_episodes": 2, "mean_score": 0.5, "standard_error": 0.1,
                 "mean_actions": 3.0},
        "stages": [stage("training 1", steps=7),
                   stage("correction 1", solved=1, corrected=2, labels=9),
                   stage("last training", steps=5), stage("test")],
    }  # fmt: skip
    row = distill.row_of(report)
    assert row["steps"] == 12 and row["round_1_solved"] == 1 and row["training_cpu_minutes"] == 2
    assert row["correction_cpu_minutes"] == 1
    for each in (row, row, {**row, "seed": 1}):
        distill.keep(each, tmp_path / "rows.jsonl")
    assert [json.loads(line)["seed"] for line in (tmp_path / "rows.jsonl").open()] == [0, 1]
