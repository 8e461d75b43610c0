"""Training by gradients into a folder: it goes on, chooses on validation seeds, and is tested."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

from learning.control import film
from learning.control import train as training
from learning.control.apg import Apg
from learning.control.evaluate import evaluate_control
from learning.control.run import ControlRun
from learning.control.train import ControlTrainConfig, train_control
from learning.runs.folder import read_snapshot
from warp_deform.collecting.control_video import film_control_episodes
from warp_deform.command.main import main
from warp_deform.errors import InputError, WarpDeformError

FEW: dict[str, Any] = {
    "task": "whip-target", "worlds": 8, "episodes": 8, "horizon": 2, "updates": 4, "snapshots": 2,
    "validate": 8,
}  # fmt: skip


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a run goes on from is kept after every second update."""
    monkeypatch.setattr(training, "LINE_STEPS", 2)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    train_control(ControlTrainConfig(**FEW, out=out, progress=False))
    return out


def killed_at(number: int, monkeypatch: pytest.MonkeyPatch, kind: type = Apg) -> None:
    """Let an update be interrupted."""
    update = kind.update

    def dies(self: Apg, k: int) -> dict[str, float]:
        if k == number:
            raise KeyboardInterrupt
        return update(self, k)

    monkeypatch.setattr(kind, "update", dies)


@pytest.mark.parametrize("method", ["apg", "shac", "plan"])
def test_killed_and_called_again_it_ends_with_the_same_weights(
    method: str, whole: Path, tmp_path: Path, often: None,
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    flags = ["--worlds", "8", "--episodes", "8", "--updates", "4", "--snapshots", "2",
             "--validate", "8", "--method", method]  # fmt: skip
    flags += [] if method == "plan" else ["--horizon", "2"]
    if method != "apg":
        whole = tmp_path / "whole"
        assert main(["train-control", "whip-target", "--out", str(whole), *flags]) == 0
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        learners = {"apg": Apg, "shac": training.Shac, "plan": training.PlanLearner}
        killed_at(4, patch, learners[method])
        assert main(["train-control", "whip-target", "--out", str(out), *flags]) == 130
    assert "updates up to 2 are kept, the same command goes on" in capfd.readouterr().err
    assert main(["train-control", "whip-target", "--out", str(out), *flags, "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["snapshots"] == [2, 4] and report["chosen"] in (2, 4)
    assert report["cpu_seconds"] > 0.0 and np.isfinite(report["loss"])
    for step in (2, 4):
        one, other = (read_snapshot(ControlRun(each).snapshot(step)) for each in (whole, out))
        assert one[1]["digest"] == other[1]["digest"]
        assert ControlRun(out).validated()[step] == ControlRun(whole).validated()[step]


def test_the_best_on_validation_seeds_is_tested_on_others(
    whole: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = ControlRun(whole)
    results = run.validated()
    assert list(results) == [2, 4] and all(each["n_episodes"] == 8 for each in results.values())
    assert run.chosen() == max(results, key=lambda step: (results[step]["mean_score"], step))
    run.write_validation(2, {**results[2], "mean_score": 1.0})
    assert run.chosen() == 2
    run.write_validation(2, results[2])
    assert main(["eval-control", str(whole), "--episodes", "11", "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    test = report["test"]
    assert report["first_seed"] == 10_000 and len(report["left"]) == test["n_episodes"] == 11
    assert test["mean_score"] == pytest.approx(np.mean(report["scores"]))
    low, high = test["mean_score_ci95"]
    assert low <= test["mean_score"] <= high and low < high
    assert json.loads((whole / "control_info.json").read_text()) == report
    earlier = evaluate_control(whole, episodes=8, step=2, progress=False)
    assert earlier["selected"] == 2 and earlier["validation"] == results[2]
    assert json.loads((whole / "control_info.json").read_text()) == report


def test_a_film_shows_the_episodes_that_are_tested(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    shown = []
    monkeypatch.setattr(film, "film_control_episodes", lambda rows, path: shown.extend(rows))
    line = ["eval-control", str(whole), "--episodes", "3", "--json", "--video"]
    assert main([*line, str(tmp_path / "film.mp4")]) == 0
    report = json.loads(capfd.readouterr().out)
    assert [[each.info.seed for each in row] for row in shown] == [[10_000], [10_001]]
    for (episode,), score, left in zip(shown, report["scores"], report["left"], strict=False):
        assert len(episode.steps) == 3 and episode.info.task == "whip-target"
        assert episode.steps[-1].score == pytest.approx(score, abs=1e-6) and left is not None
    monkeypatch.undo()
    film_control_episodes([shown[0]], tmp_path / "film.mp4", size=(54, 96))
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] > 30


def test_updates_that_fill_no_line_of_the_log_are_counted(tmp_path: Path) -> None:
    report = train_control(ControlTrainConfig(**FEW, out=tmp_path / "run", progress=False))
    assert FEW["updates"] < training.LINE_STEPS
    assert report.cpu_seconds > 0.0 and report.loss is not None


def test_minutes_are_planned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minutes = {**FEW, "updates": None, "minutes": 0.01, "snapshots": 1}
    config = ControlTrainConfig(**minutes, out=tmp_path / "run", progress=False)
    monkeypatch.setattr(training, "_planned", lambda *_: 3)
    assert train_control(config).updates == 3
    monkeypatch.setattr(training, "_planned", lambda *_: 5)
    assert train_control(config).updates == 3
    monkeypatch.undo()
    worlds = training.TensorControlWorlds("whip-target", 8, horizon=2, action_penalty=0.0)
    few, more = (training._planned(replace(config, minutes=m), worlds) for m in (0.05, 0.5))
    assert 3 < few < more < 30_000


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--updates", "4", "--snapshots", "5"], "4 updates do not make 5 snapshots"),
        (["--episodes", "8", "--worlds", "9"], "draws 9 of 8 episodes; give --episodes 9 or more"),
        (["--method", "sac"], "invalid choice"),
    ],
)
def test_wrong_flags_are_one_line(
    flags: list[str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["train-control", "whip", "--out", str(tmp_path / "r"), *flags]) == 2
    err = capfd.readouterr().err
    assert said in err and err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_tasks_and_folders_that_do_not_fit_are_one_line(
    whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    state = "the same command goes on"
    for line, said in (
        (["train-control", "whipp", "--out", str(tmp_path / "r")], "whipp"),
        (["train-control", "cable-mask-goal", "--out", str(tmp_path / "r")], "jaw"),
        (["train-control", "whip-target", "--out", str(whole)], "another"),
        (["eval-control", str(whole), "--video", str(tmp_path / "a.avi")], "must end with .mp4"),
        (["eval-control", str(empty)], "holds no training run; `warp-deform train-control`"),
        (["eval", str(whole)], "use `warp-deform eval-control"),
        (["report", str(whole)], "eval"),
    ):
        assert main(line) == 2, line
        err = capfd.readouterr().err
        last = err.strip().splitlines()[-1]
        assert last.startswith("warp-deform: ") and said in last and state not in last, err
    assert not (tmp_path / "r").exists()


def test_a_training_that_breaks_ends_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = {"loss": float("nan"), "gradient": 0.0, "guards": 0.0, "unusable": 8.0, "bounded": 0.0}
    monkeypatch.setattr(Apg, "update", lambda *_: told)
    with pytest.raises(WarpDeformError, match="no number after 1 updates"):
        train_control(ControlTrainConfig(**FEW, out=tmp_path / "run", progress=False))
    assert not (tmp_path / "run").exists()


def test_a_run_of_other_settings_or_half_a_run_is_refused(whole: Path, tmp_path: Path) -> None:
    config = ControlTrainConfig(**FEW, out=whole, progress=False)
    for change in ({"seed": 1}, {"lr": 1e-4}, {"method": "shac"}, {"updates": 8}):
        with pytest.raises(InputError, match="holds a run with another"):
            train_control(replace(config, **change))
    (tmp_path / "log.jsonl").write_text("")
    with pytest.raises(InputError, match=r"parts of a run and no run\.json"):
        train_control(replace(config, out=tmp_path))
    assert asdict(config)["task"] == "whip-target"
