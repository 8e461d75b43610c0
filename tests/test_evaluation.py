"""Evaluation: honest numbers, the same however the work is spread, on seeds of their own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from training_samples import write_demonstrations

from learning import evaluation
from learning.evaluation import (
    Evaluation,
    Played,
    Protocol,
    best,
    evaluate_snapshot,
    known,
    summarise,
)
from learning.report_run import evaluate_run
from learning.snapshots import RunFolder
from learning.training import Schedule, TrainConfig, train
from warp_deform.cli import main
from warp_deform.errors import InputError

TASK = "cable-line-notarget"
SCHEDULE = Schedule(steps=2, batch=4, lr=1e-3, snapshots=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A baseline that knows nothing, over blocks: its episodes are quick."""
    root = tmp_path_factory.mktemp("run")
    data = write_demonstrations(root / "demos", 2, task="block-notarget")
    config = TrainConfig(
        task="block-notarget", agent="gt-mlp", data=data, out=root / "run", preset="fast",
        schedule=SCHEDULE,
    )  # fmt: skip
    train(config)
    return RunFolder(root / "run")


def played(scores: list[float], successes: int) -> list[Played]:
    return [
        Played(seed, seed < successes, score, 3 + seed, "solved")
        for seed, score in enumerate(scores)
    ]


def test_a_summary_is_what_the_textbook_says() -> None:
    summary = summarise(played([1.0] * 15 + [0.5] * 5, 15), task=TASK)
    assert summary["n_episodes"] == 20 and summary["n_success"] == 15
    # Wilson's interval for 15 of 20, in closed form
    n, p, z = 20, 0.75, 1.959963984540054
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert summary["pc_success_ci95"] == pytest.approx(
        [100 * (centre - half), 100 * (centre + half)]
    )
    assert summary["mean_score"] == pytest.approx(0.875)
    assert summary["standard_error"] == pytest.approx(
        np.std([1] * 15 + [0.5] * 5, ddof=1) / 20**0.5
    )
    assert summary["mean_actions"] == pytest.approx(12.5)
    assert summary["mean_actions_solved"] == pytest.approx(10.0)


@pytest.mark.parametrize(("task", "value"), [(TASK, 87.5), ("cable-ring", 75.0)])
def test_the_papers_value_is_partial_credit_for_some_tasks(task: str, value: float) -> None:
    assert summarise(played([1.0] * 15 + [0.5] * 5, 15), task=task)["paper_value"] == value


def test_without_successes_and_with_one_episode() -> None:
    summary = summarise(played([0.25], 0), task=TASK)
    assert summary["mean_actions_solved"] is None and summary["standard_error"] is None
    assert summary["pc_success_ci95"][0] == pytest.approx(0.0, abs=1e-9)
    json.dumps(summary, allow_nan=False)


def test_the_best_snapshot_counts_what_the_task_counts() -> None:
    def made(step: int, scores: list[float], successes: int) -> Evaluation:
        episodes = tuple(played(scores, successes))
        return Evaluation(step, episodes, summarise(episodes, task=TASK))

    found = [made(1, [0.9, 0.9], 0), made(2, [1.0, 0.1], 1), made(3, [0.9, 0.9], 0)]
    assert best(found, task=TASK).step == 3, "of equals the latest"
    assert best(found, task="cable-ring").step == 2
    hasty = replace(found[0], summary={**found[0].summary, "mean_actions": 1.0})
    assert best([hasty, *found[1:]], task=TASK).step == 1, "of equals that with fewer actions"


def test_splits_do_not_overlap_with_training_or_each_other() -> None:
    seeds = [set(Protocol(split=s, episodes=1000).seeds) for s in ("validation", "test")]
    assert not seeds[0] & seeds[1]
    assert min(seeds[0] | seeds[1]) >= 10_000 and max(seeds[0] | seeds[1]) < 100_000
    with pytest.raises(InputError, match="1 or more"):
        Protocol(split="test", episodes=0)


def test_neither_workers_nor_parts_change_a_result(run: RunFolder) -> None:
    step = run.steps()[-1]
    whole = Protocol(split="validation", episodes=12)
    together = evaluate_snapshot(run, step, whole)
    for path in run.evaluations.iterdir():
        path.unlink()
    part = replace(whole, episodes=5)
    assert not known(run, step, part)
    assert evaluate_snapshot(run, step, part).episodes == together.episodes[:5]
    assert known(run, step, part) and not known(run, step, whole)
    assert evaluate_snapshot(run, step, whole, workers=2) == together
    assert [e.seed for e in together.episodes] == list(range(50_000, 50_012))


def test_what_was_played_is_not_played_again(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    protocol = Protocol(split="validation", episodes=3)
    first = evaluate_snapshot(run, 1, protocol)

    def never(chunk: object) -> None:
        raise AssertionError

    monkeypatch.setattr(evaluation, "_play_chunk", never)
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
    for key in ("n_episodes", "n_success", "pc_success", "pc_success_ci95", "mean_score",
                "mean_actions"):  # fmt: skip
        assert all(key in row for row in (*report["snapshots"].values(), report["test"]))
    again = evaluate_run(run.path, episodes=4, validation_episodes=3, workers=1)
    assert again["test"] == report["test"] and again["snapshots"] == report["snapshots"]


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
        task="block-notarget", agent="gt-mlp", data=run.path.parent / "demos", out=tmp_path,
        preset="fast", schedule=replace(SCHEDULE, steps=6, snapshots=6), validate=2, patience=2,
    )  # fmt: skip
    report = train(config)
    assert report.stopped_early and report.snapshots == (1, 2, 3)
    again = train(config)
    assert again.snapshots == report.snapshots and again.weights_hash == report.weights_hash
