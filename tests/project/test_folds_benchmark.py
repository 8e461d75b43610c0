"""The script behind what docs/simulator.md says of folds."""

from __future__ import annotations

import json
import sys

from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import folds


def test_sheets_are_folded_twice_and_their_edges_counted() -> None:
    published = json.loads((ROOT / "benchmarks" / "results" / "folds.json").read_text())["rows"]
    assert {(row["rows"], row["sheets"]) for row in published} == set(folds.SHEETS.items())
    rows = folds.folded(10, 2, 0.2)
    assert [row.fold for row in rows] == [1, 2]
    same = [each for each in published if (each["rows"], each["edge_contact"]) == (10, 0.2)]
    for row, each in zip(rows, same, strict=True):
        assert row.edges == each["edges"] and row.guards == each["guards"] == 0
        assert 0 <= row.pierced_least <= row.pierced_most <= 0.05 * row.edges
        assert 0.4 < row.shortest < 1.0 and row.cpu_ms_per_second > 0
    assert folds.folded(10, 2, 0.2)[1].shortest == rows[1].shortest, "the draws are the same"
