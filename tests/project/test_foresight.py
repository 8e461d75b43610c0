"""benchmarks/foresight.py: an untrained agent gets a row and a picture, others are refused."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import cv2
import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import foresight

from learning.models.traced import Traced, TracedConfig
from learning.policy.policy import AgentDescription, ImagePolicy


def test_an_untrained_model_foresees_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = TracedConfig(channels=8, members=1)
    agent = Traced(sizes, seed=0)
    for weights in agent.parameters():
        weights.data.zero_()  # so nothing moves
    known = AgentDescription(task="cable-mask-goal", agent="traced", config=asdict(sizes))
    load = foresight.load_policy
    monkeypatch.setattr(
        foresight,
        "load_policy",
        lambda path: ImagePolicy(agent, known) if path.name == "run" else load(path),
    )
    plot, out = tmp_path / "moves.png", tmp_path / "rows.jsonl"
    arguments = ["--episodes", "1", "--plot", str(plot), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["foresight.py", str(tmp_path / "run"), *arguments])
    foresight.main()
    row = json.loads(out.read_text())
    assert row["error_mm"] == pytest.approx(row["unmoved_mm"], abs=0.01) and row["moves"] >= 1
    assert row["act_ratio"] > 0 and 0 < row["trace_ms"]
    assert cv2.imread(str(plot)).shape[0] == 640
    beside = foresight.BESIDE
    monkeypatch.setattr(sys, "argv", ["foresight.py", str(beside)])
    with pytest.raises(SystemExit, match="is no traced policy"):
        foresight.main()
