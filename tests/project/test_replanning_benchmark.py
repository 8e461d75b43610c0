"""The benchmark of plans in disturbed worlds, in seconds: its disturbances act, and rows stay."""

from __future__ import annotations

import json
import sys

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import replanning


def test_a_disturbance_acts_and_rows_of_others_stay(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "rows.jsonl"
    kept = {"task": "whip", "start": "planned", "disturbance": "none", "rounds": 0}
    out.write_text(json.dumps(kept) + "\n")
    monkeypatch.setattr(replanning, "EVALUATIONS", 100)
    arguments = ["--tasks", "whip-target", "--goals", "8", "--out", str(out), "--rounds", "0", "4"]
    monkeypatch.setattr(
        sys, "argv", ["replanning.py", *arguments, "--disturbances", "none", "damping-x1.5"]
    )
    replanning.main()
    other, *rows = (json.loads(line) for line in out.read_text().splitlines())
    assert other == kept
    left = {(row["disturbance"], row["rounds"]): row["mean_cm"] for row in rows}
    assert len(left) == 4 and all(row["goals"] == 8 and row["guards"] == 0 for row in rows)
    assert left["damping-x1.5", 0] != left["none", 0]
    for disturbance in ("none", "damping-x1.5"):
        assert left[disturbance, 4] < left[disturbance, 0], "few evaluations leave room"
