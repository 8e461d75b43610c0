"""An interruption costs a little time and no bit; what is not finite is never stored."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from fixtures.training_samples import write_demonstrations
from torch import nn

from learning.data import batches
from learning.evaluation import snapshot as evaluating
from learning.runs import log
from learning.runs.folder import RunFolder, read_json, write_json
from learning.runs.log import TrainingLog, read_log
from learning.training import train as training
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.state import Trained, state_steps
from learning.training.train import train
from warp_deform.errors import InputError, WarpDeformError

TASK = "cable-line-notarget"
pytestmark = pytest.mark.usefixtures("narrow_networks")
PICTURES = Schedule(steps=4, batch=1, lr=1e-3, warmup=2, decay=True, ema=0.9, snapshots=2)
STATES = Schedule(steps=260, batch=4, lr=3e-3, warmup=2, decay=True, ema=0.9, snapshots=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("data") / "demos", 4)


def config(folder: Path, out: Path, **changes: Any) -> TrainConfig:
    values = {"agent": "gt-mlp", "preset": "fast", "schedule": STATES} | changes
    return TrainConfig(task=TASK, data=folder, out=out, **values)


def interrupt(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> list[int]:
    """Have the batch of that call interrupted; gives the calls so far."""
    calls: list[int] = []
    original = getattr(batches, name)

    def interrupted(*args: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return original(*args, **options)

    monkeypatch.setattr(batches, name, interrupted)
    return calls


def lines(run: Path) -> list[dict[str, float]]:
    records = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [
        {name: value for name, value in line.items() if "seconds" not in name} for line in records
    ]


@pytest.mark.parametrize(
    ("agent", "schedule", "stored", "cut"),
    [
        ("goal-stack", PICTURES, 2, 4),
        ("gt-mlp", STATES, 100, 181),
        ("gt-mlp-2step", replace(STATES, place_lr=5.0, even=0.5), 100, 181),
    ],
)
def test_an_interrupted_run_goes_on_to_the_same_bits(
    agent: str,
    schedule: Schedule,
    stored: int,
    cut: int,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if agent == "goal-stack":  # whole lines of the log would take too many of its steps
        monkeypatch.setattr(training, "state_steps", lambda _: stored)
    settings = {"agent": agent, "schedule": schedule}
    whole = train(config(folder, tmp_path / "whole", **settings))
    name = "image_batch" if agent == "goal-stack" else "state_batch"
    calls = interrupt(monkeypatch, name, cut)
    with pytest.raises(KeyboardInterrupt):
        train(config(folder, tmp_path / "cut", **settings))
    resumed = train(config(folder, tmp_path / "cut", **settings))
    assert len(calls) == cut + schedule.steps - stored, "what was stored is not done again"
    assert resumed.weights_hash == whole.weights_hash and resumed.snapshots == whole.snapshots
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")
    ended = train(config(folder, tmp_path / "cut", **settings))
    assert len(calls) == cut + schedule.steps - stored
    assert ended.weights_hash == whole.weights_hash
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")


@pytest.mark.parametrize("snapshots", [1, 3, 7, 11, 150])
def test_states_are_stored_between_lines_of_the_log(snapshots: int) -> None:
    plan = Schedule(steps=20_000, batch=1, lr=1.0, snapshots=snapshots)
    assert state_steps(plan) % log.LINE_STEPS == 0


def test_what_was_logged_is_kept_whatever_ends_a_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step 60 comes before any state is stored; the line of step 50 is there all the same."""
    closed: list[bool] = []
    close = TrainingLog.close
    monkeypatch.setattr(TrainingLog, "close", lambda self: (closed.append(True), close(self))[1])
    interrupt(monkeypatch, "state_batch", 60)
    with pytest.raises(KeyboardInterrupt):
        train(config(folder, tmp_path))
    assert [line["step"] for line in lines(tmp_path)] == [50] and closed
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".tmp")]


def test_processes_do_not_share_the_log_s_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two flush at once: the second one's file appears while the first is about to rename its."""
    first, second = (
        TrainingLog(RunFolder(tmp_path), 0, tensorboard=False, enabled=True) for _ in range(2)
    )
    replace = Path.replace

    def meanwhile(path: Path, target: Path) -> Path:
        monkeypatch.setattr(Path, "replace", replace)
        monkeypatch.setattr(log.os, "getpid", lambda: 1)
        second.flush()
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", meanwhile)
    first.flush()
    assert [path.name for path in tmp_path.iterdir()] == ["log.jsonl"]


class Validation:
    """Stands in for playing: values by step, and a kill in the first validation of one of them.

    Training stops when one snapshot was not better than those before it.
    """

    def __init__(self, values: dict[int, float], *, killed: int | None = None) -> None:
        self.values, self.killed = values, killed
        self.played: set[int] = set()

    def evaluate(self, run: RunFolder, step: int, protocol: Any) -> Any:
        if step == self.killed:
            self.killed = None
            raise KeyboardInterrupt
        self.played.add(step)
        value = self.values[step]
        summary = {"n_success": 0, "n_episodes": 1, "mean_score": value, "mean_actions": 1.0}
        return SimpleNamespace(step=step, summary=summary)

    def stopped(self, run: RunFolder) -> bool:
        values = [self.values[step] for step in sorted(self.played)]
        return bool(values) and values[-1] < max(values)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(evaluating, "evaluate_snapshot", self.evaluate)
        monkeypatch.setattr(evaluating, "stopped_early", self.stopped)


def test_a_kill_during_validation_changes_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The snapshot after which training stops is validated when the run goes on, and ends it."""
    plan = Schedule(steps=300, batch=4, lr=3e-3, snapshots=3)
    values = {100: 0.5, 200: 0.4, 300: 0.9}  # better again, but nobody gets to see it
    settings: dict[str, Any] = {"schedule": plan, "validate": 1, "patience": 1}
    Validation(values).install(monkeypatch)
    whole = train(config(folder, tmp_path / "whole", **settings))
    assert whole.snapshots == (100, 200) and whole.stopped_early and whole.chosen == 100
    validation = Validation(values, killed=200)
    validation.install(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train(config(folder, tmp_path / "cut", **settings))
    resumed = train(config(folder, tmp_path / "cut", **settings))
    assert resumed.chosen == 100, "of the snapshots before the kill too"
    assert resumed.snapshots == whole.snapshots and resumed.weights_hash == whole.weights_hash
    assert validation.played == {100, 200}


def test_a_run_that_stopped_stays_as_it_is(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same command again changes neither log nor loss, though no state is due at the stop."""
    plan = Schedule(steps=300, batch=4, lr=3e-3, snapshots=4)  # 75, 150, 225, 300
    validation = Validation({75: 0.5, 150: 0.4})
    validation.install(monkeypatch)
    settings: dict[str, Any] = {"schedule": plan, "validate": 1}
    first = train(config(folder, tmp_path, **settings))
    log = (tmp_path / "log.jsonl").read_text()
    assert first.snapshots == (75, 150) and len(log.splitlines()) == 3
    again = train(config(folder, tmp_path, **settings))
    assert (tmp_path / "log.jsonl").read_text() == log
    assert (again.loss, again.weights_hash) == (first.loss, first.weights_hash)
    assert again.cpu_seconds == first.cpu_seconds > 0


def test_validation_is_no_part_of_what_steps_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0, 7.0]  # the wall's clock and the process's
    monkeypatch.setattr(log, "_clocks", lambda: tuple(now))
    made = TrainingLog(RunFolder(tmp_path), 0, tensorboard=False, enabled=True)
    for step in range(1, 101):
        now[:] = now[0] + 0.5, now[1] + 0.25
        made.add(step, {"loss": torch.zeros(())}, lr=0.1)
        if step == 30:
            with made.paused():
                now[:] = now[0] + 1000.0, now[1] + 400.0
    made.close()
    lines = read_log(RunFolder(tmp_path))
    assert [(line["seconds"], line["cpu_seconds"]) for line in lines] == [(25.0, 12.5)] * 2
    assert made.cpu_seconds() == 25.0


def test_without_patience_a_snapshot_is_validated_too(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Schedule(steps=200, batch=4, lr=3e-3, snapshots=2)
    validation = Validation({100: 0.5, 200: 0.6}, killed=100)
    validation.install(monkeypatch)
    settings: dict[str, Any] = {"schedule": plan, "validate": 1}
    with pytest.raises(KeyboardInterrupt):
        train(config(folder, tmp_path, **settings))
    assert train(config(folder, tmp_path, **settings)).snapshots == (100, 200)
    assert validation.played == {100, 200}


@pytest.mark.parametrize("snapshots", [1, 4])
def test_no_snapshot_and_no_state_hold_what_is_not_finite(
    snapshots: int, folder: Path, tmp_path: Path
) -> None:
    """The loss of step 2 is not finite, long before a line of the log is due."""
    wild = Schedule(steps=4, batch=4, lr=1e30, snapshots=snapshots)
    with pytest.raises(WarpDeformError, match=r"the loss is .* train with a lower --lr"):
        train(config(folder, tmp_path, schedule=wild))
    run = RunFolder(tmp_path)
    assert run.steps() == ([1] if snapshots == 4 else [])
    assert not run.state.exists()


@pytest.mark.parametrize("ema", [0.0, 0.9])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_are_looked_at_too(ema: float, value: float, tmp_path: Path) -> None:
    """A gradient can be lost in a step whose loss was still finite."""
    agent = nn.Linear(2, 2)
    trained = Trained(agent, replace(STATES, ema=ema), RunFolder(tmp_path), "key")
    trained.check(6)
    nn.init.constant_(agent.bias, value)
    trained.step(7, trained.gradient(agent(torch.zeros(1, 2)).sum()))
    with pytest.raises(WarpDeformError, match="weights are not finite at step 7"):
        trained.check(7)


def test_a_state_of_another_run_is_refused(folder: Path, tmp_path: Path) -> None:
    """Settings that were lost, a state that was copied here, and one of other weights."""
    one, other = (
        train(config(folder, tmp_path / name, seed=k)) and RunFolder(tmp_path / name)
        for k, name in enumerate(("one", "other"))
    )
    state = one.state.read_bytes()
    one.state.write_bytes(other.state.read_bytes())
    with pytest.raises(InputError, match=r"state\.safetensors is another run's"):
        train(config(folder, one.path))
    tensors, step, key = other.read_state()
    for spoilt in ({}, {**tensors, "more": torch.zeros(1)}):
        one.write_state(spoilt, step, key=key)
        with pytest.raises(InputError, match="is another run's"):
            train(config(folder, one.path))
    one.state.write_bytes(state)
    one.settings.unlink()
    with pytest.raises(InputError, match=r"holds parts of a run and no run\.json"):
        train(config(folder, one.path))


def test_another_release_of_a_package_is_named(folder: Path, tmp_path: Path) -> None:
    train(config(folder, tmp_path))
    run = RunFolder(tmp_path)
    settings = read_json(run.settings)
    write_json(run.settings, {**settings, "versions": {**settings["versions"], "torch": "1.0"}})
    with pytest.raises(InputError, match=r"begun with torch 1\.0, and 2\..* is installed"):
        train(config(folder, tmp_path))
