"""What is refused, or fails before there is anything to keep, leaves nothing behind."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.short_runs import said
from fixtures.training_samples import block_episode, write_demonstrations

from learning.data import batches
from learning.refinement.refine import RefineConfig, refine
from learning.report.read import read_runs
from learning.runs.folder import RunFolder
from learning.sweep import read_sweep, run_sweep
from learning.training import train as training
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.collecting.folder import Attempt, Collection, append_attempt
from warp_deform.episodes import EpisodeWriter
from warp_deform.errors import InputError, WarpDeformError

TASK = "block-notarget"
PLAN = Schedule(steps=200, batch=4, lr=1e-3, snapshots=2)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_demonstrations(tmp_path / "demos", 2, task=TASK)


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    settings = {"agent": "gt-mlp", "preset": "fast", "schedule": PLAN} | changes
    return TrainConfig(task=TASK, data=data, out=out, **settings)


def without_tensorboard(patch: pytest.MonkeyPatch) -> dict[str, Any]:
    patch.setitem(sys.modules, "torch.utils.tensorboard", None)
    return {"tensorboard": True}


def failing_batch(patch: pytest.MonkeyPatch) -> dict[str, Any]:
    def fail(*_: Any, **__: Any) -> None:
        raise InputError("episode_000000000.parquet is damaged")

    patch.setattr(batches, "state_batch", fail)
    return {}


def diverging(patch: pytest.MonkeyPatch) -> dict[str, Any]:
    return {"lr": 1e30}


def too_many(patch: pytest.MonkeyPatch) -> dict[str, Any]:
    return {"demos": 3}


@pytest.mark.parametrize("break_it", [without_tensorboard, failing_batch, diverging, too_many])
def test_a_refused_training_leaves_nothing(
    break_it: Callable[[pytest.MonkeyPatch], dict[str, Any]],
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = sorted(tmp_path.rglob("*"))
    with monkeypatch.context() as patch, pytest.raises(WarpDeformError):
        train(config(data, tmp_path / "runs" / "one", **break_it(patch)))
    made = [path for path in tmp_path.rglob("*") if path not in before]
    assert not [path for path in made if "runs" in path.parts], made
    with pytest.raises(InputError):
        read_runs([tmp_path])
    train(config(data, tmp_path / "runs" / "one"))  # the folder is free for what works


def test_a_folder_that_was_there_stays(data: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "notes").mkdir(parents=True)
    with pytest.raises(WarpDeformError):
        train(config(data, tmp_path / "run", lr=1e30))
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["notes"]


def test_what_training_goes_on_from_stays(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: list[int] = []
    original = batches.state_batch

    def late(*args: Any, **options: Any) -> Any:
        counted.append(1)
        if len(counted) == 150:
            raise InputError("a disk was unplugged")
        return original(*args, **options)

    monkeypatch.setattr(batches, "state_batch", late)
    with pytest.raises(InputError, match="unplugged"):
        train(config(data, tmp_path / "run"))
    run = RunFolder(tmp_path / "run")
    assert run.settings.exists() and run.state.exists() and run.steps() == [100]
    assert train(config(data, tmp_path / "run")).snapshots == (100, 200)


def test_an_interrupted_training_stays(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training.TrainingLog, "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(config(data, tmp_path / "run"))
    assert RunFolder(tmp_path / "run").settings.exists()
    train(config(data, tmp_path / "run"))


def test_seeds_of_validation_are_not_trained_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = EpisodeWriter(tmp_path / "demos")
    for seed in (50_033, 1):
        writer.write(block_episode(seed, task=TASK))
    run = str(tmp_path / "run")
    command = ["train", TASK, "--agent", "gt-mlp", "--data", str(tmp_path / "demos"),
               "--preset", "fast", "--steps", "20", "--out", run]  # fmt: skip
    error = said(capsys, *command)
    assert "seed 50033 is one of training and of the validation seeds 50000 to 50059" in error
    assert not Path(run).exists()


def test_a_refused_evaluation_plays_nothing(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(config(data, tmp_path / "run"))
    capsys.readouterr()
    before = sorted(tmp_path.rglob("*"))
    weights = RunFolder(tmp_path / "run").snapshot(200)
    whole = weights.read_bytes()
    weights.write_bytes(whole[:-9])
    said(capsys, "eval", str(tmp_path / "run"), "--episodes", "1")
    weights.write_bytes(whole)
    (tmp_path / "film").write_text("")
    said(capsys, "eval", str(tmp_path / "run"), "--video", str(tmp_path / "film"))
    (tmp_path / "film").unlink()
    assert sorted(tmp_path.rglob("*")) == before


def test_a_refused_collection_leaves_no_folder(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError),
        Collection(tmp_path / "a" / "b", {"task": TASK}).owned(),
    ):
        raise InputError("no such goal")
    assert not list(tmp_path.iterdir())
    with (
        pytest.raises(InputError),
        Collection(tmp_path / "a", {"task": TASK}).owned(),
    ):
        append_attempt(tmp_path / "a", Attempt(0, False, 1, 0.0, "missed"))
        raise InputError("no such goal")
    assert (tmp_path / "a" / "collection.json").exists(), "there is something to go on from"


def test_what_cannot_be_refined_leaves_no_folder(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: object) -> None:
        raise InputError("the episode of seed 0 does not start as recorded")

    monkeypatch.setattr("learning.refinement.refine._refine_chunk", refuse)
    with pytest.raises(InputError, match="does not start"):
        refine(RefineConfig(source=data, out=tmp_path / "refined", workers=1))
    assert not (tmp_path / "refined").exists()


def test_a_refused_sweep_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise InputError("so many episodes would need more seeds than there are")

    monkeypatch.setattr("learning.sweep.collect", refuse)
    (tmp_path / "grid.toml").write_text(
        f'out = "{tmp_path / "sweep" / "one"}"\ntasks = ["{TASK}"]\nagents = ["gt-mlp"]\n'
        "demos = [1]\n"
    )
    with pytest.raises(InputError):
        run_sweep(read_sweep(tmp_path / "grid.toml"), workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["grid.toml"]
