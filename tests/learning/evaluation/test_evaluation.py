"""Evaluation: honest numbers, the same however the work is spread, on seeds of their own."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures.training_samples import write_demonstrations

from learning.evaluation import snapshot as evaluating
from learning.evaluation.play import goal_distance
from learning.evaluation.protocol import Protocol
from learning.evaluation.run import evaluate_run
from learning.evaluation.snapshot import evaluate_snapshot, is_evaluated
from learning.evaluation.summary import FAILURES
from learning.policy.policy import load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.collecting.goals import load_goals
from warp_deform.collecting.make_goals import make_goals
from warp_deform.command.main import main
from warp_deform.episodes import EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError

TASK = "cable-line-notarget"
SCHEDULE = Schedule(steps=2, batch=4, lr=1e-3, snapshots=2)


@pytest.fixture(scope="module")
def run(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A baseline that knows nothing, over blocks: its episodes are quick."""
    root = tmp_path_factory.mktemp("run")
    shutil.copytree(trained.parent, root, dirs_exist_ok=True)
    return RunFolder(root / "run")


def test_splits_do_not_overlap_with_training_or_each_other() -> None:
    seeds = [set(Protocol(split=s, episodes=1000).seeds) for s in ("validation", "test")]
    assert not seeds[0] & seeds[1]
    assert min(seeds[0] | seeds[1]) >= 10_000 and max(seeds[0] | seeds[1]) < 100_000
    with pytest.raises(InputError, match="1 or more"):
        Protocol(split="test", episodes=0)


@pytest.mark.in_a_row("workers")
def test_neither_workers_nor_parts_change_a_result(run: RunFolder) -> None:
    step = run.steps()[-1]
    whole = Protocol(split="validation", episodes=12)
    together = evaluate_snapshot(run, step, whole)
    for path in run.evaluations.iterdir():
        path.unlink()
    part = replace(whole, episodes=5)
    assert not is_evaluated(run, step, part)
    assert evaluate_snapshot(run, step, part).episodes == together.episodes[:5]
    assert is_evaluated(run, step, part) and not is_evaluated(run, step, whole)
    assert evaluate_snapshot(run, step, whole, workers=2) == together
    assert [e.seed for e in together.episodes] == list(range(50_000, 50_012))


def test_what_was_played_is_not_played_again(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    protocol = Protocol(split="validation", episodes=3)
    first = evaluate_snapshot(run, 1, protocol)

    def never(chunk: object) -> None:
        raise AssertionError

    monkeypatch.setattr(evaluating, "_play_chunk", never)
    assert evaluate_snapshot(run, 1, protocol) == first
    with pytest.raises(AssertionError):
        evaluate_snapshot(run, 1, replace(protocol, stage_rule="privileged"))


def test_a_run_is_reported_once(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["eval", str(run.path), "--episodes", "4", "--validation-episodes", "3",
                 "--workers", "1", "--json"]  # fmt: skip
    assert main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads(run.report.read_text())
    assert report["snapshots"].keys() == {"1", "2"}
    assert report["test"]["n_episodes"] == 4 and report["paper"] is None
    assert report["selected"] in (1, 2)
    assert run.chosen_snapshot() == run.snapshot(report["selected"])
    for key in (
        "n_episodes",
        "n_success",
        "pc_success",
        "pc_success_ci95",
        "mean_score",
        "mean_actions",
    ):
        assert all(key in row for row in (*report["snapshots"].values(), report["test"]))
    again = evaluate_run(run.path, episodes=4, validation_episodes=3, workers=1)
    assert again["test"] == report["test"] and again["snapshots"] == report["snapshots"]


def test_a_shared_run_is_the_chosen_snapshot_in_half_its_bytes(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = tmp_path / "shared"
    short = ["--episodes", "2", "--validation-episodes", "2", "--workers", "1", "--json"]
    arguments = ["eval", str(run.path), *short, "--share", str(shared)]
    assert main(arguments) == 0
    weights = Path(json.loads(capsys.readouterr().out)["shared"])
    chosen = run.chosen_snapshot()
    assert RunFolder(shared).chosen_snapshot() == weights and weights.name == chosen.name
    assert weights.stat().st_size < 0.55 * chosen.stat().st_size
    assert str(tmp_path) not in (shared / "run.json").read_text()
    before, after = (load_policy(each).agent.state_dict() for each in (chosen, shared))
    for name, each in before.items():
        torch.testing.assert_close(after[name], each, rtol=2**-8, atol=0)
    assert main(["eval", str(shared), *short]) == 0
    assert json.loads(capsys.readouterr().out)["demos"] == 2
    assert main(arguments) == 2
    assert "exists" in capsys.readouterr().err
    more = TrainConfig(
        task="block-notarget",
        agent="gt-mlp",
        data=run.path.parent / "demos",
        out=shared,
        preset="fast",
        schedule=SCHEDULE,
    )
    with pytest.raises(InputError, match="shared policy"):
        train(more)


def test_goals_come_from_goal_seeds(run: RunFolder) -> None:
    evaluate_snapshot(run, 1, Protocol(split="test", episodes=2))
    folders = sorted((run.path / "goals").iterdir())
    names = [path.name for folder in folders for path in folder.glob("*.parquet")]
    assert names and all(name >= "episode_000100000.parquet" for name in names)


def test_training_stops_when_validation_brings_nothing_better(
    run: RunFolder, tmp_path: Path
) -> None:
    """A baseline that knows nothing scores 0 from the first snapshot on."""
    config = TrainConfig(
        task="block-notarget",
        agent="gt-mlp",
        data=run.path.parent / "demos",
        out=tmp_path,
        preset="fast",
        schedule=replace(SCHEDULE, steps=6, snapshots=6),
        validate=2,
        patience=2,
    )
    report = train(config)
    assert report.stopped_early and report.snapshots == (1, 2, 3)
    again = train(config)
    assert again.snapshots == report.snapshots and again.weights_hash == report.weights_hash


def test_the_untrained_network_is_played_and_never_chosen(tmp_path: Path) -> None:
    data = write_demonstrations(tmp_path / "demos", 2, task="block-notarget")
    plain = TrainConfig(
        task="block-notarget",
        agent="gt-mlp",
        data=data,
        out=tmp_path / "plain",
        preset="fast",
        schedule=SCHEDULE,
    )
    first = train(plain)
    with_it = train(replace(plain, out=tmp_path / "both", untrained=True))
    assert with_it.weights_hash == first.weights_hash
    assert with_it.snapshots == (0, 1, 2) and first.snapshots == (1, 2)
    assert train(replace(plain, untrained=True)).snapshots == (0, 1, 2), "also afterwards"
    zero, one = (RunFolder(tmp_path / "both").snapshot(step) for step in (0, 1))
    assert RunFolder(tmp_path / "plain").snapshot(0).read_bytes() == zero.read_bytes()
    assert zero.read_bytes() != one.read_bytes()
    report = evaluate_run(tmp_path / "both", episodes=1, validation_episodes=1, paper=False)
    assert report["snapshots"].keys() == {"0", "1", "2"} and report["selected"] == 2


def test_a_folder_of_goals(run: RunFolder, tmp_path: Path) -> None:
    make_goals("block-notarget", tmp_path / "goals", count=2, kind="constructed", seed=100_007)
    protocol = Protocol(split="test", episodes=3, goal_folder=tmp_path / "goals")
    given = evaluate_snapshot(run, 1, protocol)
    own = evaluate_snapshot(run, 1, replace(protocol, goal_folder=None))
    distances = [each.goal_l2 for each in given.episodes]
    assert all(each and len(each) == 3 for each in distances), "a start and two actions"
    assert distances[0] != own.episodes[0].goal_l2
    copy = tmp_path / "copy"
    (tmp_path / "goals").rename(copy)
    assert is_evaluated(run, 1, replace(protocol, goal_folder=copy)), (
        "goals count, not where they lie"
    )
    with pytest.raises(InputError):
        evaluate_snapshot(run, 1, protocol)


def test_goals_that_do_not_fit_are_told_of_in_one_line(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_goals("block-notarget", tmp_path / "goals", count=1, kind="constructed")
    episode = EpisodeReader(tmp_path / "goals").read(100_000)
    for name, info in {
        "imported": replace(episode.info, extra={}),
        "garbled": replace(episode.info, extra={"goal_targets": ["a"]}),
        "others": replace(episode.info, task=TASK),
    }.items():
        EpisodeWriter(tmp_path / name).write(replace(episode, info=info))
        assert main(["eval", str(run.path), "--goals", str(tmp_path / name)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and ("goals of" in said or "means as a goal" in said)
    with pytest.raises(InputError, match="means as a goal"):
        load_goals(tmp_path / "imported")


def test_distance_to_the_goal() -> None:
    """As in the original but for bytes that wrap around: 1 - 2 is -1, not 255."""
    color = np.full((4, 2, 3), 2, np.uint8)
    assert goal_distance(color, color) == 0.0
    assert goal_distance(color - 1, color) == goal_distance(color + 1, color)
    assert goal_distance(color + 3, color) == pytest.approx(3 * math.sqrt(24) / 24)


def test_failures_are_counted(run: RunFolder) -> None:
    result = evaluate_snapshot(run, 1, Protocol(split="validation", episodes=3))
    failed = [each for each in result.episodes if not each.success]
    assert all(each.failure in FAILURES for each in failed)
    assert sum(result.summary["failures"].values()) == len(failed) > 0
    assert result.summary["goal_l2"] == pytest.approx(
        np.mean([each.goal_l2[-1] for each in result.episodes if each.goal_l2])
    )
