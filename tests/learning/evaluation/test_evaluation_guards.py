"""Evaluation plays nothing twice, and refuses what would not be an honest number."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.places import ROOT
from fixtures.short_runs import SHORT, TASK, said, settle
from fixtures.training_samples import block_episode

from learning.evaluation import protocol, share
from learning.evaluation import snapshot as evaluating
from learning.evaluation.protocol import Protocol, check_splits, goals_for, goals_of
from learning.evaluation.run import evaluate_run
from learning.evaluation.share import share_run
from learning.evaluation.snapshot import evaluate_snapshot, stopped_early, trained_steps
from learning.evaluation.summary import Evaluation, PlayedEpisode, measure, summarise, wilson
from learning.policy.policy import AgentDescription, ImagePolicy, RetryingPolicy, make_agent
from learning.runs.folder import RunFolder, read_json
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError


def plan(run: RunFolder, steps: int) -> dict[str, Any]:
    return {**read_json(run.settings)["schedule"], "steps": steps}


def test_a_longer_evaluation_plays_what_is_missing(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the same goals: goal k is that of seed 100,000 + k, however many there are."""
    first = evaluate_snapshot(run, 2, Protocol(split="test", episodes=2))
    goals = run.path / "goals" / "constructed-100000-ur5"
    before = {path.name: path.read_bytes() for path in goals.glob("*.parquet")}
    assert len(before) == 2
    chunks = []
    play = evaluating._play_chunk

    def counted(chunk: evaluating._Chunk) -> Iterator[PlayedEpisode]:
        chunks.append(chunk.seeds)
        return play(chunk)

    monkeypatch.setattr(evaluating, "_play_chunk", counted)
    longer = Protocol(split="test", episodes=4)
    second = evaluate_snapshot(run, 2, longer)
    assert chunks == [(10_002, 10_003)] and second.episodes[:2] == first.episodes
    assert [path.name for path in (run.path / "goals").iterdir()] == [goals.name]
    after = {path.name: path.read_bytes() for path in goals.glob("*.parquet")}
    assert len(after) == 4 and before.items() <= after.items()
    shutil.rmtree(run.evaluations)
    assert evaluate_snapshot(run, 2, longer) == second, "in one go"
    assert len(list(run.evaluations.iterdir())) == 1
    turns = goals_of(goals, replace(longer, n_goals=3), [10_000, 10_002, 10_003])
    assert [goal.seed for goal in turns.values()] == [100_000, 100_002, 100_000]


def test_fewer_goals_are_another_result(run: RunFolder) -> None:
    many = evaluating._Results(run, 2, Protocol(split="test", episodes=4))
    few = evaluating._Results(run, 2, Protocol(split="test", episodes=4, n_goals=2))
    assert many._path != few._path
    of_itself = Protocol(split="validation", episodes=4)
    assert (
        evaluating._Results(run, 2, of_itself)._path
        == evaluating._Results(run, 2, replace(of_itself, n_goals=2))._path
    )


def test_goals_are_made_by_the_arm_that_plays(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def make(task: str, out: Path, **options: Any) -> dict[str, Any]:
        asked.append((out.name, options["robot"], options["count"]))
        return {"goals": options["count"]}

    monkeypatch.setattr(protocol, "make_goals", make)
    for robot in ("ur5", "panda"):
        goals_for(run, TASK, Protocol(split="test", episodes=3, robot=robot))
    assert asked == [("constructed-100000-ur5", "ur5", 3), ("constructed-100000-panda", "panda", 3)]


def test_processes_get_small_chunks(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    class Crew:
        def __init__(self, count: int) -> None:
            self.count = count

        def __enter__(self) -> Crew:
            return self

        def __exit__(self, *error: object) -> None: ...

        def run(self, function: object, chunks: list[Any]) -> Iterator[PlayedEpisode]:
            sizes.append([len(chunk.seeds) for chunk in chunks])
            for chunk in chunks:
                yield from (PlayedEpisode(seed, False, 0.0, 1, "") for seed in chunk.seeds)

    monkeypatch.setattr(evaluating, "Workers", Crew)
    monkeypatch.setattr(evaluating, "goals_for", lambda *_: None)
    evaluate_snapshot(run, 2, Protocol(split="test", episodes=50), workers=2)
    evaluate_snapshot(run, 1, Protocol(split="test", episodes=20), workers=2)
    evaluate_snapshot(run, 1, Protocol(split="validation", episodes=20), workers=1)
    assert sizes == [[16, 16, 16, 2], [10, 10], [20]]


def test_a_snapshot_is_hashed_once(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    reads = []
    read = Path.read_bytes

    def counted(path: Path) -> bytes:
        reads.extend([path] if path.suffix == ".safetensors" else [])
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    evaluate_snapshot(run, 2, Protocol(split="validation", episodes=4))
    assert len(reads) == 1


def test_a_run_that_is_half_trained_is_refused(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    settle(run, schedule=plan(run, 8))
    error = said(capsys, "eval", str(run.path), *SHORT)
    assert "2 of 8 steps" in error and "`warp-deform train` to its end" in error
    with pytest.raises(InputError, match="to its end"):
        share_run(run.path, run.path.parent / "shared")
    settle(run, rounded="bfloat16")  # of a run that was handed on, one snapshot is left
    assert trained_steps(run) == 8
    settle(run, trained_steps=6)
    assert trained_steps(run) == 6


def test_a_run_that_stopped_early_is_finished(run: RunFolder) -> None:
    settle(run, schedule=plan(run, 8), patience=1, validate=2)
    assert not stopped_early(run), "nothing was validated"
    validation = Protocol(split="validation", episodes=2)
    records = {step: evaluating._Results(run, step, validation) for step in (1, 2)}
    for step, score in ((1, 0.5), (2, 0.5)):
        for seed in validation.seeds:
            records[step].add(PlayedEpisode(seed, score == 1.0, score, 1, ""))
    assert stopped_early(run) and trained_steps(run) == 2
    settle(run, patience=2)
    assert not stopped_early(run)
    settle(run, patience=1)
    first, second = validation.seeds
    records[2].add(PlayedEpisode(first, True, 1.0, 1, ""))
    assert not stopped_early(run), "it was getting better"
    records[2].add(PlayedEpisode(second, True, 1.0, 1, ""))
    assert stopped_early(run), "it cannot get better"
    records[2].add(PlayedEpisode(second, False, 0.5, 1, ""))
    with pytest.raises(InputError, match="to its end"):
        evaluate_run(run.path, episodes=1, progress=False)


def test_stopping_is_judged_by_the_versions_that_trained(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = {**read_json(run.settings)["versions"], "torch": "0.0.1"}
    settle(run, schedule=plan(run, 8), patience=1, validate=1, versions=older)
    with monkeypatch.context() as patch:
        patch.setattr(evaluating, "versions", lambda: older)
        for step in (1, 2):
            record = evaluating._Results(run, step, Protocol(split="validation", episodes=1))
            record.add(PlayedEpisode(50_000, False, 0.0, 1, ""))
    assert stopped_early(run)


def test_a_run_says_who_demonstrated(run: RunFolder) -> None:
    infos = EpisodeReader(Path(read_json(run.settings)["data"])).infos()
    names = sorted({info.demonstrator for info in infos})
    assert names and read_json(run.settings)["demonstrators"] == names


def test_the_steps_are_reported(run: RunFolder) -> None:
    report = evaluate_run(run.path, episodes=1, validation_episodes=1, workers=1, progress=False)
    assert report["steps"] == report["trained_steps"] == 2


@pytest.mark.parametrize(
    ("seed", "expected"), [(50_000, "validation seeds"), (10_000, "test seeds"), (100_000, "goal")]
)
def test_what_was_trained_on_is_not_played(
    run: RunFolder, capsys: pytest.CaptureFixture[str], seed: int, expected: str
) -> None:
    settle(run, demonstrations={"0": "a", str(seed): "b"})
    assert expected in said(capsys, "eval", str(run.path), *SHORT)
    assert not run.evaluations.exists() and not (run.path / "goals").exists()


def test_validation_is_as_hard_as_the_test_where_a_goal_shows_its_start(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def make(task: str, out: Path, *, count: int, seed: int, **options: Any) -> dict[str, Any]:
        asked.append(seed)
        return {"goals": count}

    monkeypatch.setattr(protocol, "make_goals", make)
    validation, test = (Protocol(split=s, episodes=3) for s in ("validation", "test"))
    assert goals_for(run, TASK, validation) is None  # a goal shows nothing but where the cable lies
    folders = {goals_for(run, "bag-color-goal", each) for each in (validation, test)}
    assert len(folders) == 2 and None not in folders and asked == [140_000, 100_000]


def test_splits_are_apart() -> None:
    test, validation = (Protocol(split=s, episodes=20) for s in ("test", "validation"))
    check_splits([0, 9_999, 10_020, 50_020, 100_020], [validation, test], task=TASK)
    check_splits([100_000], [validation, test], task="cable-ring")  # it has no goals
    with pytest.raises(InputError, match="100030 is one of training and of the test goal"):
        demonstrated = replace(test, goals="demonstrated")  # some attempts fail
        check_splits([100_030], [test, demonstrated], task=TASK)
    check_splits([140_000], [validation, test], task=TASK)  # validation has its starts' own goals
    check_splits([120_000, 140_020], [validation, test], task="bag-color-goal")
    with pytest.raises(InputError, match="140000 is one of training and of the validation goal"):
        check_splits([140_000], [validation, test], task="bag-color-goal")
    with pytest.raises(InputError, match="seed 50000 is one of validation and of test"):
        check_splits([], [validation, replace(test, episodes=50_000)], task=TASK)
    check_splits([], [validation, test], task=TASK, goals=[9_999, 49_999, 99_999, 200_000])
    check_splits([], [validation, test], task="cable-ring", goals=[100_000])
    for split, seed in (("test", 100_019), ("validation", 50_019)):
        with pytest.raises(InputError, match=f"the goal of seed {seed}, .* those of {split};"):
            check_splits([], [validation, test], task=TASK, goals=[7, seed])
    check_splits([], [validation, test], task="bag-color-goal", goals=[50_000])
    with pytest.raises(InputError, match="the goal of seed 200003, which is one of those of test"):
        later = replace(test, first_seed=110_000)
        check_splits([], [validation, later], task=TASK, goals=[200_003])
    huge = Protocol(split="test", episodes=10**12)
    with pytest.raises(InputError, match="fewer episodes"):
        check_splits([], [validation, huge], task=TASK)


def test_goals_that_were_trained_on_are_refused(
    run: RunFolder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate_snapshot(run, 2, Protocol(split="test", episodes=1))
    goals = next((run.path / "goals").iterdir())
    settle(run, demonstrations={"100000": "a"})
    assert "goals in" in said(capsys, "eval", str(run.path), *SHORT, "--goals", str(goals))


def test_too_many_processes_are_taken_for_a_mistake(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    error = said(capsys, "eval", str(run.path), "--workers", "100000")
    assert "workers is 100000" in error


def test_the_papers_rule_chooses_the_lift_where_there_are_several(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def judged(run: RunFolder, step: int, protocol: Protocol, **_: Any) -> Evaluation:
        seen.append((protocol.split, protocol.goals, protocol.stage_rule))
        episodes = tuple(PlayedEpisode(seed, False, 0.0, 1, "") for seed in protocol.seeds)
        return Evaluation(step, episodes, summarise(episodes, task=TASK))

    monkeypatch.setattr("learning.evaluation.run.evaluate_snapshot", judged)
    for lifts, rule in (([0.05], "action"), ([0.05, 0.3], "privileged")):
        agent = read_json(run.settings)["agent"]
        settle(run, agent={**agent, "config": {**agent["config"], "lifts": lifts}})
        seen.clear()
        report = evaluate_run(run.path, episodes=1, paper=True, progress=False)
        assert report["paper"]["stage_rule"] == rule and report["stage_rule"] == "action"
        assert set(seen) == {
            ("validation", "constructed", "action"),
            ("test", "constructed", "action"),
            ("test", "demonstrated", rule),
        }


def test_a_shared_run_is_shared_again(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    share_run(run.path, first)

    def full(*_: Any) -> None:
        raise OSError("no space is left")

    with monkeypatch.context() as patch:
        patch.setattr(share, "write_json", full)
        with pytest.raises(OSError, match="no space"):
            share_run(first, second)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "run"], "nothing is left"
    weights = share_run(first, second)
    assert weights.read_bytes() == RunFolder(first).chosen_snapshot().read_bytes()
    assert read_json(second / "run.json") == read_json(first / "run.json")
    with pytest.raises(InputError, match="exists"):
        share_run(first, second)


def test_a_picture_that_is_missing_is_told_of_every_time() -> None:
    config = {"width": 0.0625, "crop": 16}
    description = AgentDescription(task="cable-ring", agent="transporter", config=fast(**config))
    policy = RetryingPolicy(ImagePolicy(make_agent(description), description))
    step = block_episode(0).steps[0]
    seen = {"color": step.color, "height": step.height}
    for _ in range(2):
        with pytest.raises(InputError, match="no 'color'"):
            policy.act({})
    first = policy.act(seen)
    with pytest.raises(InputError, match="no 'color'"):
        policy.act({"height": step.height})
    second = policy.act(seen)
    assert not np.array_equal(first[:2], second[:2]), "the pick is still known to have failed"


def fast(**changes: Any) -> dict[str, Any]:
    """The preset's configuration, changed."""
    from learning.models.transporter import PRESETS

    return {**vars(PRESETS["fast"]), **changes}


def test_one_measure_and_one_interval() -> None:
    assert measure("fabric-flat") == "mean_score" and measure("cable-mask-goal") == "pc_success"
    low, high = wilson(5, 10)
    assert low + high == pytest.approx(100) and 0 < low < 50


def test_goals_in_a_folder_that_grew_by_hand(run: RunFolder) -> None:
    """A given folder is shared whole, one that is made as far as `n_goals` says."""
    made = goals_for(run, TASK, Protocol(split="test", episodes=3))
    assert made is not None and len(EpisodeReader(made)) == 3
    given = Protocol(split="test", episodes=4, goal_folder=made)
    assert [goal.seed for goal in goals_of(made, given, [10_003]).values()] == [100_000]
    assert goals_for(run, TASK, Protocol(split="test", episodes=1)) == made
    assert len(EpisodeReader(made)) == 3, "never fewer"


@pytest.mark.parametrize(
    "path",
    [path for room in ("evaluation", "policy", "report", "runs")
     for path in sorted((ROOT / "learning" / room).glob("[!_]*.py"))],
    ids=lambda path: f"{path.parent.name}-{path.stem}",
)  # fmt: skip
def test_public_names_are_exported(path: Path) -> None:
    defined, exported = set(), set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            defined.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = {each.id for each in ast.walk(ast.Tuple(targets)) if isinstance(each, ast.Name)}
            defined |= names - {"__all__"}
            if "__all__" in names and node.value is not None:
                exported = set(ast.literal_eval(node.value))
    assert {each for each in defined if not each.startswith("_")} == exported
