"""The script behind what docs/simulator.md says of folds."""

from __future__ import annotations

import json
import sys

from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import folds


def test_sheets_are_folded_twice_and_their_edges_counted() -> None:
    published = json.loads((ROOT / "benchmarks" / "results" / "folds.json").read_text())["rows"]
    plain = [row for row in published if row["fabric"] == "plain"]
    assert {(row["rows"], row["sheets"]) for row in plain} == set(folds.SHEETS.items())
    rows = folds.folded(10, 2, 0.2)
    assert [row.fold for row in rows] == [1, 2]
    same = [each for each in plain if (each["rows"], each["edge_contact"]) == (10, 0.2)]
    for row, each in zip(rows, same, strict=True):
        assert row.edges == each["edges"] and row.guards == each["guards"] == 0
        assert 0 <= row.pierced_least <= row.pierced_mean <= row.pierced_most <= 0.02 * row.edges
        assert 0.4 < row.shortest < 1.0 and row.cpu_ms_per_second > 0
    assert folds.folded(10, 2, 0.2)[1].shortest == rows[1].shortest, "the draws are the same"


def test_what_is_published_of_the_fabric_of_the_tasks_keeps_its_limits() -> None:
    published = json.loads((ROOT / "benchmarks" / "results" / "folds.json").read_text())["rows"]
    tasks = [row for row in published if row["fabric"] == "tasks"]
    assert [(row["fold"], row["sheets"]) for row in tasks] == [
        (fold, folds.OF_TASKS) for fold in (1, 2, 3, 4)
    ]
    assert sum(row["pierced_mean"] for row in tasks) / 4 <= 0.001 * 261
    assert max(row["pierced_most"] for row in tasks) <= 0.01 * 261
