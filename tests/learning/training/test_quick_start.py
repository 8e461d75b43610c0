"""From nothing to a tested policy: training ends when validation says so, and plays nothing twice.

Episodes are stood in for, so that it takes seconds; `benchmarks/policies.py` times the real thing.
"""

from __future__ import annotations

import importlib.util
import json
import shlex
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest
from fixtures.places import ROOT
from fixtures.training_samples import write_demonstrations

from learning.evaluation import snapshot as evaluating
from learning.evaluation.summary import PlayedEpisode
from learning.runs.folder import RunFolder
from warp_deform.command.main import main

TASK = "cable-line-notarget"
pytestmark = pytest.mark.usefixtures("narrow_networks")


class Episodes:
    """Plays for a policy that solves all but what is hard from a step on."""

    def __init__(self, solves_from: int, hard: Collection[tuple[int, int]] = ()) -> None:
        self.solves_from, self.hard = solves_from, hard
        self.played: list[tuple[int, int]] = []

    def __call__(self, chunk: evaluating._Chunk) -> Iterator[PlayedEpisode]:
        step = int(chunk.snapshot.stem.split("_")[1])
        for seed in chunk.seeds:
            self.played.append((step, seed))
            solved = step >= self.solves_from or seed % 2 == 0
            solved = solved and (step, seed) not in self.hard
            yield PlayedEpisode(
                seed, solved, 1.0 if solved else 0.5, 3, "", None if solved else "other"
            )


@pytest.fixture
def commands(tmp_path: Path) -> tuple[list[str], list[str], Path]:
    data, run = write_demonstrations(tmp_path / "demos", 2), tmp_path / "runs" / "line"
    train = ["train", TASK, "--agent", "goal-split", "--preset", "fast", "--steps", "16",
             "--data", str(data), "--out", str(run), "--json"]  # fmt: skip
    return train, ["eval", str(run), "--episodes", "4", "--workers", "1", "--json"], run


def test_the_plain_commands_stop_when_all_is_solved(
    commands: tuple[list[str], list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train, evaluate, run = commands
    episodes = Episodes(solves_from=2)
    monkeypatch.setattr(evaluating, "_play_chunk", episodes)
    assert main(train) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["snapshots"] == [1, 2] and report["stopped_early"]
    assert report["chosen"] == 2
    assert [each["n_success"] for each in report["validation"].values()] == [10, 60]
    seeds = [(1, 20), (2, 60)]
    assert episodes.played == [(step, 50_000 + n) for step, count in seeds for n in range(count)]
    assert [line.split(":")[0] for line in said.err.splitlines()] == [f"train {TASK}"] * 2
    assert "validation 60 of 60 solved, mean score 1.000" in said.err

    # the same command again changes nothing and plays nothing
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert main(train) == 0
    again = json.loads(capsys.readouterr().out)
    assert {**again, "seconds": 0} == {**report, "seconds": 0}
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}

    episodes.played.clear()
    assert main(evaluate) == 0
    tested = json.loads(capsys.readouterr().out)
    assert tested["selected"] == 2 and tested["test"]["n_success"] == 4
    assert episodes.played == [(2, 10_000 + n) for n in range(4)], "validation was played before"


def test_what_the_first_episodes_cannot_tell_the_further_ones_do(
    commands: tuple[list[str], list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Twenty of twenty are no end of the training where one of the next forty is not solved."""
    train, _, _ = commands
    episodes = Episodes(solves_from=2, hard={(2, 50_059), (5, 50_058), (5, 50_059), (10, 50_020)})
    monkeypatch.setattr(evaluating, "_play_chunk", episodes)
    assert main(train) == 0
    report = json.loads(capsys.readouterr().out)
    assert [each["n_success"] for each in report["validation"].values()] == [10, 59, 58, 59]
    assert report["stopped_early"] and report["patience"] == 2, "neither 58 nor 59 is a gain"


def test_what_is_not_solved_is_trained_to_the_end(
    commands: tuple[list[str], list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train, _, run = commands
    monkeypatch.setattr(evaluating, "_play_chunk", Episodes(solves_from=99))
    assert main([*train, "--patience", "0"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["snapshots"] == [1, 2, 5, 10, 16] and not report["stopped_early"]
    assert report["patience"] is None
    assert RunFolder(run).read_settings()["validate"] == 20


def test_two_snapshots_that_bring_nothing_end_it(
    commands: tuple[list[str], list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train, _, _ = commands
    monkeypatch.setattr(evaluating, "_play_chunk", Episodes(solves_from=99))
    assert main(train) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["snapshots"] == [1, 2, 5] and report["stopped_early"]
    assert (report["patience"], report["chosen"]) == (2, 5), "of equals the last"


def test_a_better_score_is_a_gain_where_nothing_is_solved(
    commands: tuple[list[str], list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A hard task is not given up while it is still being learnt."""
    train, _, _ = commands

    def play(chunk: evaluating._Chunk) -> Iterator[PlayedEpisode]:
        step = int(chunk.snapshot.stem.split("_")[1])
        for seed in chunk.seeds:
            yield PlayedEpisode(seed, False, step / 20 - (step == 16), 3, "", "other")

    monkeypatch.setattr(evaluating, "_play_chunk", play)
    assert main(train) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["snapshots"] == [1, 2, 5, 10, 16] and report["chosen"] == 10


def test_the_pages_have_the_commands_that_were_timed() -> None:
    spec = importlib.util.spec_from_file_location("policies", ROOT / "benchmarks" / "policies.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    timed = module.commands(module.parser().parse_args([]))
    page = (ROOT / "docs" / "learning.md").read_text()
    shown = [shlex.split(line) for line in page.splitlines() if line.startswith("    warp-deform ")]
    folders = {
        "demos",
        "runs/line",
        str(Path("runs/benchmark/demos") / TASK),
        str(Path(f"runs/benchmark/runs/{TASK}-goal-split-10")),
    }

    def essence(arguments: list[str]) -> list[str]:
        return sorted(each for each in arguments if each not in folders)

    assert [essence(each[1:]) for each in shown[:3]] == [essence(each) for each in timed.values()]
    rows = [json.loads(line) for line in module.WRITTEN.read_text().splitlines()]
    row = next(row for row in rows if row["task"] == TASK and row["agent"] == "goal-split")
    for page in ("learning.md", "results.md"):
        text = (ROOT / "docs" / page).read_text()
        assert f"{row['n_success']} of {row['n_episodes']} episodes" in text
        for name in ("demo", "train", "eval"):
            assert f"{row[f'{name}_cpu_seconds']:.0f}" in text
