"""benchmarks/gaussians_in_use.py: how a baseline is trained, what is in use, and a whole cell."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from fixtures.benchmark_scripts import benchmark

from learning.runs.folder import RunFolder


@pytest.fixture
def script() -> Iterator[Any]:
    with benchmark("gaussians_in_use") as module:
        yield module


def test_what_is_in_use_is_counted_together_and_a_state(script: Any) -> None:
    one, other = torch.eye(26)[3], torch.eye(26)[7]
    assert script.counted(torch.stack([one, one])) == pytest.approx((1.0, 1.0))
    assert script.counted(torch.stack([one, other])) == pytest.approx((2.0, 1.0))
    both = (one + other) / 2
    assert script.counted(torch.stack([both, both])) == pytest.approx((2.0, 2.0))
    assert script.counted(torch.full((4, 26), 1 / 26)) == pytest.approx((26.0, 26.0))


@pytest.mark.parametrize(("agent", "network"), [("gt-mlp", "network"), ("gt-mlp-2step", "pick")])
def test_a_cell_is_trained_played_and_not_done_again(
    agent: str, network: str, script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, out = tmp_path / "work", tmp_path / "rows.jsonl"
    arguments = ["--tasks", "block-notarget", "--demos", "2", "--seeds", "1", "--steps", "8"]
    arguments += ["--agents", agent, "--episodes", "2", "--work", str(work), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["gaussians_in_use.py", *arguments])
    plan = script.preset_schedule
    monkeypatch.setattr(
        script, "preset_schedule", lambda *a, **k: replace(plan(*a, **k), validate=0, snapshots=1)
    )
    played = partial(script.evaluate_run, validation_episodes=1)
    monkeypatch.setattr(script, "evaluate_run", played)
    script.main()
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["way"] for row in rows] == list(script.WAYS)
    for way, (less_one, even) in script.WAYS.items():
        settings = RunFolder(work / f"block-notarget-{agent}-2-8-{way}-1").read_settings()
        assert settings["agent"]["config"]["cosines_less_one"] is less_one
        assert settings["schedule"].get("even") == (0.5 if even else None)
    assert all(row["n_episodes"] == 2 and row["steps"] == 8 for row in rows)
    assert all(20 < row["gaussians"] <= 26 for row in rows)  # nothing is learnt in eight steps
    script.main()
    assert len(out.read_text().splitlines()) == 4

    load = script.load_policy

    def collapsed(run: Path) -> Any:
        policy = load(run)
        getattr(policy.agent, network).mixing.bias.data[3] += 1e3
        return policy

    monkeypatch.setattr(script, "load_policy", collapsed)
    run, demos = work / f"block-notarget-{agent}-2-8-both-1", work / "block-notarget-demos"
    assert script.in_use(run, demos, demos=2, seed=1) == pytest.approx((1.0, 1.0))
