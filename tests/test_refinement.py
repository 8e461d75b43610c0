"""Refinement: never worse, fewer actions, the same bits however it was run, and it replays."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from episode_samples import make_episode

from learning import refinement
from learning.refinement import REFINED, REFINEMENT, RefineConfig, RefineReport, refine
from warp_deform.cli import main
from warp_deform.collect import CollectConfig, collect
from warp_deform.episodes import Episode, EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError
from warp_deform.planning import SearchConfig
from warp_deform.replay import verify

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
        (["--out", "new", "--budget", "0"], "must be 1 or more"),
        (["--out", "new", "--workers", "0"], "workers is 0"),
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


def _boxes(folder: Path) -> None:
    EpisodeWriter(folder).write(_sample(task="block-notarget"))


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
        (_boxes, "no derivatives"),
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
        "seconds", "state_hash",
    }  # fmt: skip
    assert report["episodes"] == 1
