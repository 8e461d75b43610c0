"""Evaluation: honest numbers, the same however the work is spread, on seeds of their own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fixtures.training_samples import write_demonstrations

from learning.evaluation import snapshot as evaluating
from learning.evaluation.failures import (
    FAILURES,
    bag_holds_items,
    bag_opening,
    closed,
    failure,
    puts_back,
)
from learning.evaluation.play import PlayedEpisode, goal_distance
from learning.evaluation.protocol import Protocol
from learning.evaluation.run import evaluate_run
from learning.evaluation.snapshot import evaluate_snapshot, is_evaluated
from learning.evaluation.summary import Evaluation, best, summarise
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
from warp_deform.tasks.bag_items import BagItems1
from warp_deform.tasks.cable_line import CableLineNotarget
from warp_deform.worlds.loop import EpisodeRun

TASK = "cable-line-notarget"
SCHEDULE = Schedule(steps=2, batch=4, lr=1e-3, snapshots=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A baseline that knows nothing, over blocks: its episodes are quick."""
    root = tmp_path_factory.mktemp("run")
    data = write_demonstrations(root / "demos", 2, task="block-notarget")
    config = TrainConfig(
        task="block-notarget",
        agent="gt-mlp",
        data=data,
        out=root / "run",
        preset="fast",
        schedule=SCHEDULE,
    )
    train(config)
    return RunFolder(root / "run")


def played(scores: list[float], successes: int) -> list[PlayedEpisode]:
    return [
        PlayedEpisode(seed, seed < successes, score, 3 + seed, "solved")
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


def test_successes_whose_items_the_bag_enclosed_are_counted_apart() -> None:
    plain = played([1.0, 1.0, 1.0, 0.1], 3)
    ends = (True, False, None, True)  # of the third the physics was not trusted
    episodes = [replace(each, enclosed=held) for each, held in zip(plain, ends, strict=True)]
    summary = summarise(episodes, task="bag-items-1")
    assert (summary["n_success"], summary["n_success_enclosed"]) == (3, 1)
    assert summarise(plain, task="bag-items-1")["n_success_enclosed"] is None


def test_without_successes_and_with_one_episode() -> None:
    summary = summarise(played([0.25], 0), task=TASK)
    assert summary["mean_actions_solved"] is None and summary["standard_error"] is None
    assert summary["pc_success_ci95"][0] == pytest.approx(0.0, abs=1e-9)
    json.dumps(summary, allow_nan=False)


def test_the_best_snapshot_counts_what_the_task_counts() -> None:
    def made(step: int, scores: list[float], successes: int) -> Evaluation:
        episodes = tuple(played(scores, successes))
        return Evaluation(step, episodes, summarise(episodes, task=TASK))

    evaluations = [made(1, [0.9, 0.9], 0), made(2, [1.0, 0.1], 1), made(3, [0.9, 0.9], 0)]
    assert best(evaluations, task=TASK).step == 3, "of equals the latest"
    assert best(evaluations, task="cable-ring").step == 2
    hasty = replace(evaluations[0], summary={**evaluations[0].summary, "mean_actions": 1.0})
    assert best([hasty, *evaluations[1:]], task=TASK).step == 1, "of equals that with fewer actions"


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


def action(pick: tuple[float, float], place: tuple[float, float], lift: float = 0.05) -> np.ndarray:
    return np.array([*pick, 0.0, *place, 0.0, lift])


THERE = action((0.5, 0.0), (0.6, 0.2))
BACK = action((0.61, 0.21), (0.5, 0.02))
ELSEWHERE = action((0.3, -0.3), (0.4, 0.4))


@pytest.mark.parametrize(
    ("actions", "expected"),
    [
        ([THERE, BACK, THERE], True),
        ([THERE, BACK], False),
        ([THERE, THERE, THERE], False),
        ([THERE, BACK, ELSEWHERE, BACK], False),
        ([THERE, ELSEWHERE] * 3, False),
        ([], False),
    ],
)
def test_actions_that_put_back(actions: list[np.ndarray], expected: bool) -> None:
    assert puts_back(actions) is expected


def test_an_opening_that_was_closed_for_good() -> None:
    assert closed([0.6, 0.3, 0.3], [True, True])
    assert not closed([0.6, 0.3, 0.5], [True, True]), "it was opened again"
    assert not closed([0.6, 0.3], [False]), "a carry closes any bag"
    assert closed([0.6, 0.3, 0.1], [True, False])
    assert not closed([0.6], [])


class _Bag(BagItems1):
    covered, inside = False, False

    def hidden(self, *_: Any) -> bool:
        return self.covered

    def inside_bag(self, *_: Any) -> bool:
        return self.inside


@pytest.mark.parametrize(
    ("expected", "lifts", "outcomes", "openings", "covered", "inside"),
    [
        ("missed grasp", [0.05, 0.05], ["missed", "placed"], [0.4] * 3, True, False),
        ("missed grasp", [0.05, 0.05], ["unreachable", "missed"], [0.4] * 3, True, False),
        ("destructive bag action", [0.05, 0.3], ["placed"] * 2, [0.6, 0.3, 0.3], True, False),
        ("item not enclosed", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], True, False),
        ("opening covered", [0.05, 0.05], ["placed"] * 2, [0.3] * 3, True, False),
        ("opening covered", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], True, True),
        ("other", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], False, True),
    ],
)
def test_failures_of_bags(
    expected: str,
    lifts: list[float],
    outcomes: list[str],
    openings: list[float],
    covered: bool,
    inside: bool,
) -> None:
    task = _Bag()
    task.covered, task.inside = covered, inside
    snapshot = SimpleNamespace(body_q=np.zeros((1, 7)))
    episode = SimpleNamespace(physics_ok=True, snapshot=snapshot, layout=None)
    worlds: Any = SimpleNamespace(task=task, episodes={0: episode})
    run: EpisodeRun[Any] = EpisodeRun(0, np.random.default_rng(0))
    run.actions = [action((0.3, 0.1 * n), (0.6, 0.0), lift) for n, lift in enumerate(lifts)]
    run.outcomes, run.ended = outcomes, "not solved"
    assert failure(worlds, 0, run, openings) == expected and expected in FAILURES
    assert bag_holds_items(worlds, 0) is inside
    run.ended = "solved"
    assert failure(worlds, 0, run, openings) is None
    run.ended, episode.physics_ok = "physics: stretch", False
    assert failure(worlds, 0, run, openings) == "physics"


def test_failures_without_a_bag() -> None:
    episode = SimpleNamespace(physics_ok=True, snapshot=None, layout=None)
    worlds: Any = SimpleNamespace(task=CableLineNotarget(), episodes={0: episode})
    assert bag_opening(worlds, 0) is None and bag_holds_items(worlds, 0) is None
    run: EpisodeRun[Any] = EpisodeRun(0, np.random.default_rng(0))
    run.actions, run.outcomes = [THERE, BACK, THERE], ["placed"] * 3
    run.ended = "not solved in 3 actions"
    assert failure(worlds, 0, run, [None] * 4) == "back and forth"
    run.actions = [ELSEWHERE] * 3
    assert failure(worlds, 0, run, [None] * 4) == "other"


def test_failures_are_counted(run: RunFolder) -> None:
    result = evaluate_snapshot(run, 1, Protocol(split="validation", episodes=3))
    failed = [each for each in result.episodes if not each.success]
    assert all(each.failure in FAILURES for each in failed)
    assert sum(result.summary["failures"].values()) == len(failed) > 0
    assert result.summary["goal_l2"] == pytest.approx(
        np.mean([each.goal_l2[-1] for each in result.episodes if each.goal_l2])
    )
