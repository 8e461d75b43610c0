"""Demonstrations that are not learnt from, and the snapshot that does best on them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.training_samples import write_demonstrations

from learning.data.dataset import Demonstrations
from learning.policy.policy import load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.errors import InputError

TASK = "cable-line-notarget"
pytestmark = pytest.mark.usefixtures("narrow_networks")
STATES = Schedule(steps=300, batch=16, lr=3e-3, snapshots=3, ema=0.9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("data") / "demos", 6)


def config(folder: Path, out: Path, **changes: Any) -> TrainConfig:
    values = {"agent": "gt-mlp", "preset": "fast", "schedule": STATES, "hold_out": 2} | changes
    return TrainConfig(task=TASK, data=folder, out=out, **values)


def test_nothing_is_learnt_from_what_is_held_out(folder: Path) -> None:
    data = Demonstrations(folder, task=TASK, spare=2)
    held_out = data.spared(2)
    assert len(data) == 4 and len(held_out) == 2
    assert not set(data.seeds) & set(held_out.seeds)
    assert held_out.seeds == Demonstrations(folder, task=TASK, spare=2).spared(2).seeds
    few = Demonstrations(folder, task=TASK, count=3, spare=1)
    assert few.seeds == Demonstrations(folder, task=TASK, count=3).seeds, "as without"
    with pytest.raises(InputError, match="too few to learn from 5 and hold out 2; collect more"):
        Demonstrations(folder, task=TASK, count=5, spare=2)


@pytest.mark.parametrize("agent", ["gt-mlp", "goal-split"])
def test_the_snapshot_of_the_lowest_loss_is_taken(agent: str, folder: Path, tmp_path: Path) -> None:
    plan = STATES if agent == "gt-mlp" else replace(STATES, steps=3, batch=1)
    report = train(config(folder, tmp_path, agent=agent, schedule=plan))
    run = RunFolder(tmp_path)
    losses = run.held_out()
    assert losses == report.held_out and tuple(losses) == report.snapshots
    assert len(set(losses.values())) == 3, "weights differ"
    best = min(losses, key=losses.__getitem__)
    assert run.chosen_snapshot() == run.snapshot(best)
    # whichever it is: give another one the lowest
    for step in losses:
        path = run.snapshot(step).with_suffix(".json")
        record = json.loads(path.read_text())
        path.write_text(json.dumps({**record, "held_out": float(step != report.snapshots[0])}))
    assert run.chosen_snapshot() == run.snapshot(report.snapshots[0])
    assert load_policy(tmp_path).description.agent == agent


def test_holding_out_changes_no_weight(folder: Path, tmp_path: Path) -> None:
    """The same four demonstrations, with and without a look at two others."""
    with_it, without = (
        train(config(folder, tmp_path / str(n), demos=4, hold_out=n)) for n in (2, 0)
    )
    assert with_it.weights_hash == without.weights_hash and without.held_out == {}
