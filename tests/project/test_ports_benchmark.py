"""The study of published control tasks: what has a row is not measured again."""

from __future__ import annotations

import json
import sys

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import ports


def test_each_row_is_measured_once(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "rows.jsonl"
    arguments = ["--tasks", "push-cable", "--goals", "2", "--seconds", "0.1", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["ports.py", *arguments, "--methods", "idle", "random"])
    ports.main()
    idle, random = (json.loads(line) for line in out.read_text().splitlines())
    assert (idle["method"], idle["evaluations"], idle["seconds"]) == ("idle", 0, 0.0)
    assert (random["method"], random["evaluations"], random["seconds"]) == ("random", 25, 0.1)
    # the best of 25 draws beats doing nothing, by the loss that they are chosen by
    assert random["away"] < idle["away"] and random["goals"] == idle["goals"] == 2
    assert ports.key(idle) != ports.key(idle | {"goals": 20}), "other goals are another row"
    monkeypatch.setattr(ports, "EpisodeProblem", lambda *_: pytest.fail("it has its rows"))
    ports.main()
