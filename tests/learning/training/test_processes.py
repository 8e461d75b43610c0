"""Several processes train one network: their gradients are averaged, and one of them speaks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures.places import ROOT
from fixtures.training_samples import write_demonstrations

from learning.data import batches
from learning.runs.folder import RunFolder, read_snapshot
from learning.training import train as training
from learning.training.config import TrainConfig
from learning.training.processes import join_processes
from learning.training.schedules import STATE_SCHEDULES
from learning.training.train import train
from warp_deform.errors import InputError

TASK = "cable-line-notarget"
STEPS, BATCH = 4, 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("data") / "demos", 4)


def weights(run: Path) -> torch.Tensor:
    """All weights of the last snapshot in one row."""
    tensors = read_snapshot(RunFolder(run).snapshot(STEPS))[0]
    return torch.cat([tensors[name].flatten() for name in sorted(tensors)])


def test_two_processes_train_as_one_with_both_batches(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2",
               "-m", "warp_deform", "train", TASK, "--agent", "gt-mlp", "--data", str(folder),
               "--preset", "fast", "--steps", str(STEPS), "--snapshots", "1", "--validate", "0",
               "--batch", str(BATCH), "--out", str(tmp_path / "two"), "--json"]  # fmt: skip
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, check=True, capture_output=True, env=env, text=True)
    assert json.loads(done.stdout)["steps"] == STEPS, "one report, from one process"
    settings = json.loads((tmp_path / "two" / "run.json").read_text())
    assert settings["processes"] == 2

    plan = replace(STATE_SCHEDULES["fast"], steps=STEPS, snapshots=1, batch=BATCH, validate=0)
    alone = TrainConfig(
        task=TASK, agent="gt-mlp", data=folder, out=tmp_path / "one", preset="fast", schedule=plan
    )
    original, drawn = batches.state_batch, []

    def of_both(data: Any, lifts: Any, *, augment: bool, **_: Any) -> Any:
        drawn.append(1)
        ranks = (np.random.default_rng([training._STREAM, 0, len(drawn), k]) for k in (0, 1))
        batches = [
            original(data, lifts, transitions=data.drawn(BATCH, each), rng=each, augment=augment)
            for each in ranks
        ]
        return tuple(torch.cat(parts) for parts in zip(*batches, strict=True))

    train(replace(alone, out=tmp_path / "single"))
    monkeypatch.setattr(training, "_rehearse", lambda *_: None)  # it draws a batch, too
    monkeypatch.setattr(batches, "state_batch", of_both)
    train(alone)
    two, one, single = (weights(tmp_path / name) for name in ("two", "one", "single"))
    # the mean of two means is that of all, to rounding; Adam's steps are as long as their rate
    assert float((two - one).abs().max()) < 1e-6
    assert float((two - single).abs().max()) > 1e-5, "one batch alone leads elsewhere"


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, Any]]]:
    """What torch is asked for by the second process of two, on a machine that has two GPUs."""
    asked: list[tuple[str, Any]] = []
    for name, value in (("WORLD_SIZE", "2"), ("RANK", "1"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: asked.append(("gpu", device)))
    monkeypatch.setattr(
        torch.distributed,
        "init_process_group",
        lambda backend, **options: asked.append((backend, options)),
    )
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    yield asked


def test_a_process_takes_its_own_gpu_and_waits_for_validation(
    two_gpus: list[tuple[str, Any]],
) -> None:
    with join_processes("cuda", threads=1) as process:
        assert (process.rank, process.world) == (1, 2)
        assert process.device == torch.device("cuda", 1)
    (_, chosen), (backend, options) = two_gpus
    assert backend == "nccl" and chosen == options["device_id"] == torch.device("cuda", 1)
    assert options["timeout"] >= timedelta(hours=12)


def test_more_processes_than_gpus(
    two_gpus: list[tuple[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(InputError, match="torch sees 2 GPU"), join_processes("cuda", threads=1):
        pass


@pytest.mark.parametrize(("device", "match"), [("tpu", "'tpu'"), ("cuda", "sees no CUDA device")])
def test_a_device_that_is_not_there(
    device: str, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=match), join_processes(device, threads=1):
        pass
