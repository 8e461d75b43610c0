"""The script behind what docs/simulator.md says of pairs and towers of boxes."""

from __future__ import annotations

import json
import sys

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import boxes


def test_no_pair_sank_and_the_towers_stood() -> None:
    kept = [
        boxes.Row(**row)
        for row in json.loads((ROOT / "benchmarks" / "results" / "boxes.json").read_text())["rows"]
    ]
    pairs = [row for row in kept if row.scene == "pairs"]
    assert {(row.precision, row.lanes) for row in pairs} == set(boxes.WIDTHS)
    assert all(row.worlds == boxes.PAIRS and row.sunk == row.guards == 0 for row in pairs)
    stand = [row for row in kept if row.boxes <= 10 and row.scene != "pairs"]
    assert {row.ratio for row in stand} == set(boxes.RATIOS)
    assert all(row.drift_mm < 0.1 and row.guards == 0 for row in stand)
    again = boxes.towers("turned", 2, 1.0, 8)
    same = next(row for row in kept if row.scene == "turned" and row.boxes == 2)
    assert again.drift_mm == pytest.approx(same.drift_mm, abs=1e-3)
