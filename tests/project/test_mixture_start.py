"""benchmarks/mixture_start.py: where means start, what is in use, and a whole cell."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from fixtures.places import ROOT

from learning.models.gt_state import GtState, GtStateConfig


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import mixture_start

    yield mixture_start
    del sys.modules["mixture_start"]


def means(agent: GtState) -> torch.Tensor:
    return agent.network.mean.weight.detach().unflatten(0, (26, 6))


def test_means_start_apart_or_together_and_nothing_else_changes(script: Any) -> None:
    with script.starting("together"):
        together = GtState(6, GtStateConfig(), seed=0)
    with script.starting("apart"):
        apart = GtState(6, GtStateConfig(), seed=0)
    now = GtState(6, GtStateConfig(), seed=0)
    assert (means(together) == means(together)[:1]).all()
    for name, value in now.state_dict().items():
        assert torch.equal(value, apart.state_dict()[name])
        assert torch.equal(value, together.state_dict()[name]) == (name != "network.mean.weight")


@pytest.mark.parametrize(("agent", "network"), [("gt-mlp", "network"), ("gt-mlp-2step", "pick")])
def test_a_cell_is_trained_played_and_not_done_again(
    agent: str, network: str, script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, out = tmp_path / "work", tmp_path / "rows.jsonl"
    arguments = ["--tasks", "block-notarget", "--demos", "2", "--seeds", "1", "--steps", "8"]
    arguments += ["--agents", agent, "--episodes", "2", "--work", str(work), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["mixture_start.py", *arguments])
    quick = partial(script.TrainConfig, validate=0, snapshots=1)
    monkeypatch.setattr(script, "TrainConfig", quick)
    played = partial(script.evaluate_run, validation_episodes=1)
    monkeypatch.setattr(script, "evaluate_run", played)
    script.main()
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["start"] for row in rows] == ["apart", "together"]
    assert all(row["n_episodes"] == 2 and row["steps"] == 8 for row in rows)
    assert all(20 < row["gaussians"] <= 26 for row in rows)  # nothing is learnt in eight steps
    script.main()
    assert len(out.read_text().splitlines()) == 2

    load = script.load_policy

    def collapsed(run: Path) -> Any:
        policy = load(run)
        getattr(policy.agent, network).mixing.bias.data[3] += 1e3
        return policy

    monkeypatch.setattr(script, "load_policy", collapsed)
    run, demos = work / f"block-notarget-{agent}-2-apart-1", work / "block-notarget-demos"
    assert script.in_use(run, demos, demos=2, seed=1) == pytest.approx(1.0, abs=1e-6)
