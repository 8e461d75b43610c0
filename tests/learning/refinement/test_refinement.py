"""Refinement: never worse, fewer actions, the same bits however it was run, and it replays."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixtures.episode_samples import make_episode

from learning.refinement import refine as refinement
from learning.refinement import waypoints
from learning.refinement.refine import REFINED, REFINEMENT, RefineConfig, RefineReport, refine
from learning.refinement.waypoints import WAYPOINTS, BendConfig, bend, read_path
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.replay import Recording, verify
from warp_deform.command.main import main
from warp_deform.episodes import Episode, EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError
from warp_deform.planning import SearchConfig
from warp_deform.planning.waypoints import WaypointConfig, Waypoints
from warp_deform.tasks.registry import TASKS
from warp_deform.worlds.loop import SOLVED, EpisodeRun, worlds_for

SEARCH = SearchConfig(method="cem", depth=1, budget=24, candidates=8)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos")
    collect(CollectConfig(task="cable-line-notarget", episodes=3, seed=300, out=out, workers=1))
    return out


@pytest.fixture(scope="module")
def refined(demos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RefineReport]:
    out = tmp_path_factory.mktemp("refined")
    return out, refine(RefineConfig(source=demos, out=out, search=SEARCH, workers=1))


def test_no_episode_gets_worse_and_all_together_get_shorter(
    demos: Path, refined: tuple[Path, RefineReport]
) -> None:
    out, report = refined
    before, after = EpisodeReader(demos).infos(), EpisodeReader(out).infos()
    assert [info.seed for info in after] == [info.seed for info in before]
    for old, new in zip(before, after, strict=True):
        assert new.success and new.score >= old.score and new.actions <= old.actions
    assert report.episodes == 3 and report.improved >= 1
    assert report.actions_before == sum(info.actions for info in before)
    assert report.actions_after == sum(info.actions for info in after) < report.actions_before
    assert report.score_after >= report.score_before


def test_the_metadata_tell_what_became_of_every_action(
    demos: Path, refined: tuple[Path, RefineReport]
) -> None:
    for info in EpisodeReader(refined[0]).infos():
        old, story = EpisodeReader(demos).info(info.seed), info.extra[REFINEMENT]
        assert (story["score_before"], story["score_after"]) == (old.score, info.score)
        assert (story["actions_before"], story["actions_after"]) == (old.actions, info.actions)
        assert story["state_hash_before"] == old.state_hash
        assert len(story["origins"]) == info.actions
        assert set(story["origins"]) <= {"recorded", "candidate", "drawn"}
        if story["improved"]:
            assert info.demonstrator == REFINED and info.state_hash != old.state_hash
        else:
            assert info.state_hash == old.state_hash
            assert story["origins"] == ["recorded"] * old.actions


def test_refined_episodes_replay(refined: tuple[Path, RefineReport]) -> None:
    assert verify(refined[0], workers=1)["mismatches"] == 0


def test_an_interrupted_run_goes_on_to_the_same_bits(
    demos: Path,
    refined: tuple[Path, RefineReport],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = RefineConfig(source=demos, out=tmp_path / "out", search=SEARCH, workers=1)
    whole, seeds = refinement._refined, EpisodeReader(demos).seeds
    made: list[int] = []

    def interrupted(*arguments: object) -> object:
        if made:
            raise KeyboardInterrupt
        made.append(1)
        return whole(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(refinement, "_refined", interrupted)
    with pytest.raises(KeyboardInterrupt):
        refine(config)
    assert EpisodeReader(config.out).seeds == seeds[:1]
    monkeypatch.setattr(refinement, "_refined", whole)
    assert replace(refine(config), seconds=0.0) == replace(refined[1], seconds=0.0)
    monkeypatch.setattr(refinement, "_refined", interrupted)
    assert replace(refine(config), seconds=0.0) == replace(refined[1], seconds=0.0), "all is there"
    for seed in seeds:
        paths = [EpisodeReader(folder).path(seed) for folder in (config.out, refined[0])]
        assert paths[0].read_bytes() == paths[1].read_bytes()
    with pytest.raises(InputError, match=r"another kind: search\.budget is 24 there and 8 here"):
        refine(replace(config, search=replace(SEARCH, budget=8)))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (["--out", "demos"], "is the folder to refine"),
        (["--out", "./demos/."], "is the folder to refine"),
        (["--out", "new", "--method", "luck"], "'enumerate', 'random', 'cem', 'gradient'"),
        (["--out", "new", "--depth", "3"], "--depth"),
        (["--out", "new", "--budget", "0"], "--budget is 0; allowed: 1 to"),
        (["--out", "new", "--workers", "0"], "--workers is 0"),
        ([], "--out DIR"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    change: list[str],
    expected: str,
    demos: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "demos").symlink_to(demos)
    monkeypatch.chdir(tmp_path)
    assert main(["refine", "demos", *change]) == 2
    said = capsys.readouterr()
    assert expected in said.err and said.err.count("\n") == 1 and said.out == ""
    assert not (tmp_path / "new").exists()


def _no_folder(folder: Path) -> None:
    folder.rmdir()


def _constructed(folder: Path) -> None:
    EpisodeWriter(folder).write(_sample(demonstrator="constructed"))


def _sample(**changes: object) -> Episode:
    episode = make_episode()
    known: dict[str, object] = {
        "task": "cable-ring",
        "robot": "ur5",
        "demonstrator": "scripted",
        **changes,
    }
    return replace(episode, info=replace(episode.info, **known))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("prepare", "expected"),
    [
        (_no_folder, "cannot be read as a folder of episodes"),
        (lambda folder: None, "holds no episodes"),
        (_constructed, "goals that nobody acted for"),
    ],
)
def test_what_cannot_be_refined_is_refused(
    prepare: Callable[[Path], None],
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "in").mkdir()
    prepare(tmp_path / "in")
    arguments = [str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--method", "gradient"]
    assert main(["refine", *arguments, "--json"]) == 2
    said = capsys.readouterr()
    assert expected in said.err and said.err.count("\n") == 1 and said.out == ""


def test_an_episode_that_starts_otherwise_is_refused(demos: Path, tmp_path: Path) -> None:
    episode = next(iter(EpisodeReader(demos)))
    steps = (replace(episode.steps[0], state_hash="00"), *episode.steps[1:])
    EpisodeWriter(tmp_path / "in").write(replace(episode, steps=steps))
    config = RefineConfig(source=tmp_path / "in", out=tmp_path / "out", search=SEARCH, workers=1)
    with pytest.raises(InputError, match="does not start as recorded"):
        refine(config)


def test_the_command_reports_in_json(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    EpisodeWriter(tmp_path / "in").write(next(iter(EpisodeReader(demos))))
    options = ["--method", "enumerate", "--depth", "1", "--budget", "4", "--workers", "1"]
    arguments = [str(tmp_path / "in"), "--out", str(tmp_path / "out"), *options]
    assert main(["refine", *arguments, "--json"]) == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(report) == {
        "episodes", "improved", "score_before", "score_after", "actions_before", "actions_after",
        "origins", "seconds", "state_hash",
    }  # fmt: skip
    assert report["episodes"] == 1


# -- which episode is better


def _played(score: float, actions: int, ended: str = SOLVED) -> EpisodeRun[Any]:
    run: EpisodeRun[Any] = EpisodeRun(0, np.random.default_rng(0))
    run.rows = [SimpleNamespace(score=score)] * (actions + 1)
    run.actions, run.ended = [np.zeros(7)] * actions, ended
    return run


@pytest.mark.parametrize(
    ("before", "after", "by_score", "by_solved"),
    [
        ((True, 0.90, 3), (0.90, 2), True, True),
        ((True, 0.90, 3), (0.86, 2), False, True),  # solved in less, though not as well
        ((True, 0.90, 3), (0.95, 3), True, True),
        ((True, 0.90, 3), (0.90, 3), False, False),
        ((True, 0.90, 3), (0.86, 3), False, False),
        ((True, 0.90, 3), (0.99, 4), False, False),
        ((False, 0.70, 3), (0.60, 2), False, False),  # a failure may not fail sooner
        ((False, 0.70, 3), (0.70, 2), True, True),
    ],
)
def test_the_rules_of_what_is_better(
    before: tuple[bool, float, int], after: tuple[float, int], by_score: bool, by_solved: bool
) -> None:
    info = make_episode().info
    info = replace(info, success=before[0], score=before[1], actions=before[2])
    for accept, expected in (("score", by_score), ("solved", by_solved)):
        assert refinement._better(_played(*after), info, accept) is expected
    if before[0]:
        unsolved = _played(0.99, 1, "not solved in 1 actions")
        assert not refinement._better(unsolved, info, "solved")
    broken = _played(*after)
    broken.rows.pop()
    assert not refinement._better(broken, info, "solved"), "the physics failed"


def test_no_refined_episode_loses_an_item_that_the_bag_had_kept() -> None:
    info = replace(make_episode().info, success=True, score=0.6, actions=4)
    fewer = _played(0.9, 2)
    for enclosed_before, enclosed, expected in (
        (True, False, False), (True, True, True), (False, False, True), (None, None, True),
    ):  # fmt: skip
        before = replace(
            info, extra={} if enclosed_before is None else {"enclosed": enclosed_before}
        )
        for accept in ("score", "solved"):
            assert refinement._better(fewer, before, accept, enclosed=enclosed) is expected


def test_a_rule_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="no rule 'luck'; choose from score, solved"):
        RefineConfig(source=Path("a"), out=Path("b"), accept="luck")


def test_the_report_counts_where_the_actions_of_improved_episodes_come_from(
    refined: tuple[Path, RefineReport],
) -> None:
    out, report = refined
    stories = [info.extra[REFINEMENT] for info in EpisodeReader(out).infos()]
    better = [story for story in stories if story["improved"]]
    assert sum(report.origins.values()) == sum(story["actions_after"] for story in better)
    for name, count in report.origins.items():
        assert count == sum(story["origins"].count(name) for story in better)
    assert all(story["search"]["polish"] and story["accept"] == "score" for story in stories)


def test_every_task_with_a_loss_can_be_searched_by_gradient() -> None:
    able = [name for name, kind in TASKS.items() if kind.has_loss()]
    assert {"block-notarget", "fabric-cover", "bag-items-2", "bag-color-goal"} <= set(able)
    for name in able:
        refinement._check_search(name, "ur5", SearchConfig(method="gradient"))


# -- waypoints


@pytest.fixture(scope="module")
def bent(demos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """One demonstration, and the folder of its bent paths."""
    folder = tmp_path_factory.mktemp("bent")
    EpisodeWriter(folder / "one").write(next(iter(EpisodeReader(demos))))
    arguments = [str(folder / "one"), "--out", str(folder / "out"), "--waypoints"]
    assert main(["refine", *arguments, "--budget", "15", "--workers", "1", "--json"]) == 0
    return folder / "one", folder / "out"


def test_bent_paths_are_labelled_and_run_again_to_what_is_written(bent: tuple[Path, Path]) -> None:
    demo, out = bent
    label = json.loads((out / "waypoints.json").read_text())
    assert label["demonstrator"] == WAYPOINTS and label["bending"]["steps"] == 3
    story = json.loads((out / "waypoints_000000300.json").read_text())
    episode = next(iter(EpisodeReader(demo)))
    assert story["demonstrator"] == WAYPOINTS and story["task"] == episode.info.task
    assert len(story["actions"]) == episode.info.actions
    ran = [a for a in story["actions"] if a["before"] is not None]
    assert all(a["after"]["loss"] <= a["before"]["loss"] for a in ran)
    assert any(a["path"] is not None for a in ran)
    assert story["actions"][0]["state_hash"] == episode.steps[0].state_hash
    assert ran[0]["before"]["state_hash"] == episode.steps[1].state_hash, "the action as recorded"
    number = next(n for n, a in enumerate(story["actions"]) if a["path"] is not None)
    written = story["actions"][number]
    recording = Recording(EpisodeReader(demo))
    worlds = worlds_for(story["task"], story["robot"])
    job = waypoints._recorded(worlds, recording, 300)[number]
    again = Waypoints(worlds.task, robot="ur5").run({0: job}, {0: read_path(written["path"])})
    assert asdict(again[0]) == written["after"]
    with pytest.raises(InputError, match="no path of waypoints"):
        read_path({"times": [0]})


def test_bending_goes_on_and_says_the_same(
    bent: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    demo, out = bent
    config = BendConfig(source=demo, out=out, bending=WaypointConfig(steps=3), workers=1)
    monkeypatch.setattr(waypoints, "_bend_chunk", lambda chunk: pytest.fail("all is there"))
    report = bend(config)
    assert report.episodes == 1 and report.bent >= 1 and report.demonstrator == WAYPOINTS
    assert report.loss_before is not None and report.loss_after is not None
    assert report.loss_after < report.loss_before
    with pytest.raises(InputError, match="other demonstrations or settings"):
        bend(replace(config, bending=WaypointConfig(steps=4)))


def test_nobody_takes_bent_paths_for_demonstrations(
    bent: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo, out = bent
    train = ["train", "cable-line-notarget", "--agent", "goal-split"]
    for arguments in (
        [*train, "--data", str(out), "--out", str(tmp_path / "run")],
        ["refine", str(out), "--out", str(tmp_path / "new")],
        ["replay", str(out), "--verify"],
    ):
        assert main(arguments) == 2
        said = capsys.readouterr()
        assert "holds no episodes" in said.err and said.err.count("\n") == 1
    for given, expected in (
        (["--out", str(demo)], "another folder"),
        (["--out", str(demo.parent)], "holds something else"),
        (["--out", str(tmp_path / "new"), "--depth", "1"], "only --budget and --workers"),
        (["--out", str(tmp_path / "new"), "--budget", "4"], "costs 5"),
    ):
        assert main(["refine", str(demo), "--waypoints", *given]) == 2
        said = capsys.readouterr()
        assert expected in said.err and said.err.count("\n") == 1
    assert not (tmp_path / "new").exists()
