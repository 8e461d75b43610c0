"""`eval --first-seed`: other test episodes, kept apart; and who made and played a run."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from fixtures.short_runs import SHORT, TASK, said, settle

from learning.evaluation import snapshot as evaluating
from learning.evaluation.play import play_policy
from learning.evaluation.protocol import Protocol, check_splits
from learning.evaluation.run import evaluate_run
from learning.evaluation.snapshot import evaluate_snapshot
from learning.policy.policy import load_policy
from learning.report.report import write_report
from learning.runs.folder import RunFolder, read_json
from warp_deform import __version__
from warp_deform.command.main import main
from warp_deform.errors import InputError
from warp_deform.support.progress import PlainLines
from warp_deform.worlds.loop import worlds_for

ONE = {"validation_episodes": 1, "workers": 1, "progress": False}


def test_other_seeds_are_kept_apart(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    usual = evaluate_run(run.path, episodes=2, **ONE)
    command = ["eval", str(run.path), *SHORT, "--first-seed", "20000", "--json"]
    assert main(command) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    played = answer.pop("played")
    assert {key: answer[key] for key in usual if key != "other_seeds"} == {
        key: usual[key] for key in usual if key != "other_seeds"
    }
    assert answer == read_json(run.report) and answer["other_seeds"] == {"20000": played}
    assert played["first_seed"] == 20_000 and played["test"]["n_episodes"] == 1
    files = [read_json(path) for path in run.evaluations.iterdir()]
    seeds = {each["seed"] for file in files for each in file["episodes"]}
    assert seeds == {50_000, 10_000, 10_001, 20_000}
    goals = {path.name for path in (run.path / "goals").iterdir()}
    assert goals == {"constructed-100000-ur5", "constructed-110000-ur5"}, "goals of their own"
    # the usual seeds again keep what others came to, and play nothing
    before = {path: path.read_bytes() for path in run.evaluations.iterdir()}
    again = evaluate_run(run.path, episodes=2, **ONE)
    assert again["other_seeds"] == {"20000": played} and again["test"] == usual["test"]
    assert before == {path: path.read_bytes() for path in run.evaluations.iterdir()}
    (note,) = write_report([run.path], None).data["notes"]
    assert "also played seeds 20000 and up: 0 of 1 solved" in note


def test_without_the_usual_seeds_a_report_leaves_a_run_out(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(run.path), *SHORT, "--first-seed", "20000"]) == 0
    assert "20000 to 20000, kept apart" in capsys.readouterr().out
    assert read_json(run.report)["test"] is None
    assert "no run is evaluated yet" in said(capsys, "report", str(run.path))
    assert run.chosen_snapshot() in map(run.snapshot, run.steps()), (
        "a policy is loaded all the same"
    )


def test_an_evaluation_tells_of_every_episode(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[str, int, PlainLines]] = []

    @contextlib.contextmanager
    def heard(what: str, total: int, **options: Any) -> Iterator[PlainLines]:
        lines = PlainLines(what, total, tell=lambda _: None, clock=lambda: 0.0)
        shown.append((what, total, lines))
        yield lines

    monkeypatch.setattr("learning.evaluation.run.progress_bar", heard)
    for _ in range(2):  # played, and read
        shown.clear()
        evaluate_run(run.path, episodes=3, **ONE)
        assert [(what, total) for what, total, _ in shown] == [
            (f"eval {TASK}, validation", 2),
            (f"eval {TASK}, test", 3),
        ]
        assert "3 of 3 episodes, step " in shown[1][2].line()
        assert ": 0 of 3 solved, " in shown[1][2].line()


def test_the_usual_first_seed_is_the_usual_evaluation(run: RunFolder) -> None:
    report = evaluate_run(run.path, episodes=1, first_seed=10_000, **ONE)
    assert report["test"]["n_episodes"] == 1 and report["other_seeds"] == {}


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        (0, "seed 0 is one of training and of the test seeds 0 to 199"),
        (49_990, "seed 50000 is one of validation and of test"),
        (-1, "--first-seed is -1; allowed: 0 to"),
        (10**9, "it must be 0 to"),
    ],
)
def test_seeds_that_overlap_are_refused(
    run: RunFolder, capsys: pytest.CaptureFixture[str], first: int, expected: str
) -> None:
    assert expected in said(capsys, "eval", str(run.path), "--first-seed", str(first))
    assert not run.evaluations.exists() and not run.report.exists()


def test_goals_of_other_seeds_are_not_trained_on() -> None:
    other = Protocol(split="test", episodes=5, first_seed=30_000)
    check_splits([110_000], [other], task=TASK)
    with pytest.raises(InputError, match="120004 is one of training and of the test goal seeds"):
        check_splits([120_004], [other], task=TASK)


def test_what_was_played_before_keeps_its_name() -> None:
    """Files of results are found again, though a protocol can say more now."""
    usual, others = (Protocol(split="test", episodes=5, first_seed=s) for s in (None, 30_000))
    described = evaluating._described(usual, TASK)
    assert "first_seed" not in described and "motions_must_succeed" not in described
    assert evaluating._described(others, TASK)["first_seed"] == 30_000


class OutOfReach:
    """Stands in for a policy: its second action is beyond the arm's reach."""

    def __init__(self, policy: Any) -> None:
        self.description = policy.description
        self.acted = 0

    def act(self, observation: Mapping[str, np.ndarray], *, rng: Any) -> np.ndarray:
        self.acted += 1
        far = 5.0 if self.acted == 2 else 0.3
        return np.array([far, -0.3, 0.0, 0.5, 0.0, 0.0, 0.04])


@pytest.mark.parametrize("strict", [True, False])
def test_a_motion_that_fails_ends_an_episode_by_the_papers_protocol(
    run: RunFolder, strict: bool
) -> None:
    policy = OutOfReach(load_policy(run.snapshot(2)))
    protocol = Protocol(split="test", episodes=1, motions_must_succeed=strict)
    worlds = worlds_for("bag-alone-open", "ur5")
    ((_, played, episode),) = play_policy(policy, worlds, protocol, [10_000])  # type: ignore[arg-type]
    assert episode.outcomes[1] == "unreachable" and not played.success
    assert played.actions == (2 if strict else worlds.task.max_actions)
    assert (played.reason == "a motion failed") is strict


def test_the_papers_protocol_asks_for_motions_that_succeed(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[bool, bool]] = []
    original = evaluate_snapshot

    def heard(run: RunFolder, step: int, protocol: Protocol, **options: Any) -> Any:
        seen.append((protocol.goals == "demonstrated", protocol.motions_must_succeed))
        return original(run, step, Protocol(split="validation", episodes=1), **options)

    monkeypatch.setattr("learning.evaluation.run.evaluate_snapshot", heard)
    evaluate_run(run.path, episodes=1, paper=True, **ONE)
    assert set(seen) == {(True, True), (False, False)}


def test_a_run_says_who_made_it_and_a_report_shows_it(run: RunFolder) -> None:
    (revision,) = read_json(run.settings)["revisions"]
    assert revision.keys() == {"version", "commit", "dirty"} and revision["version"] == __version__
    evaluated = evaluate_run(run.path, episodes=1, **ONE)
    assert evaluated["revision"] == revision
    older = {"version": "0.0.9", "commit": "a" * 40, "dirty": True}
    settle(run, revisions=[older, revision])
    report = write_report([run.path], None)
    (origin,) = report.data["origins"]
    assert origin["trained_by"] == [older, revision] and origin["evaluated_by"] == revision
    assert "0.0.9 at aaaaaaaaaaaa, edited; " in report.text
    settings = {k: v for k, v in read_json(run.settings).items() if k != "revisions"}
    run.settings.write_text(json.dumps(settings))
    assert write_report([run.path], None).data["origins"][0]["trained_by"] is None
