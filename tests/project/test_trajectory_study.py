"""`benchmarks/trajectory_study.py` in seconds: a row a method, each measured once."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

SCRIPT = ROOT / "benchmarks" / "trajectory_study.py"


def test_each_row_is_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "rows.jsonl"
    few = ["--tasks", "block-notarget", "--episodes", "1", "--seconds", "0.5", "--horizon", "200"]
    places = ["--work", str(tmp_path / "work"), "--out", str(out)]
    for methods in (["random"], ["random", "adam"]):
        before = out.read_text() if out.exists() else ""
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *few, "--methods", *methods, *places])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        assert before in out.read_text()
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["method"] for row in rows] == ["adam", "random"]
    for row in rows:
        assert row["loss_low"] <= row["loss"] <= row["loss_high"] <= 1.0
        assert row["evaluations"] >= 24 and 0 <= row["improved"] <= 1
