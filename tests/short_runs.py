"""Runs that took seconds to train, for tests of what is done with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from training_samples import write_demonstrations

from learning.runs.folder import RunFolder, read_json, write_json
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.command.main import main

TASK = "block-notarget"
SHORT = ["--episodes", "1", "--validation-episodes", "1", "--workers", "1"]


def train_shortly(root: Path) -> Path:
    """A baseline that knows nothing, over blocks, with snapshots of steps 1 and 2."""
    data = write_demonstrations(root / "demos", 2, task=TASK)
    config = TrainConfig(
        task=TASK,
        agent="gt-mlp",
        data=data,
        out=root / "run",
        preset="fast",
        schedule=Schedule(steps=2, batch=4, lr=1e-3, snapshots=2),
    )
    train(config)
    return config.out


def settle(run: RunFolder, **changes: Any) -> None:
    """Change what `run.json` says."""
    write_json(run.settings, {**read_json(run.settings), **changes})


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command says that has to refuse."""
    assert main(list(arguments)) == 2
    found = capsys.readouterr()
    assert found.err.count("\n") == 1 and not found.out
    return found.err
