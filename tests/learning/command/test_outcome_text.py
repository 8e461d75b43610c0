"""What people read at the end of `train` and `eval`: whose number it is, and no more digits."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from fixtures.short_runs import TASK

from learning.command.outcome_text import evaluated, trained
from learning.evaluation.summary import PlayedEpisode, summarise
from learning.runs.folder import RunFolder
from learning.training import train as training
from warp_deform.command import main as cli
from warp_deform.command.main import main

TRAINED: dict[str, Any] = {
    "task": "cable-line-notarget", "agent": "goal-split", "preset": "fast", "demos": 10,
    "corrected": 0, "labels": 27,
    "left_out": 0, "seed": 0, "steps": 250, "planned_steps": 4000, "patience": None, "chosen": 250,
    "validation": {250: {"n_success": 20, "n_episodes": 20, "mean_score": 1.0}},
    "snapshots": (250,),
    "loss": 8.814481811523438, "held_out": {}, "seconds": 148.22304895700006,
    "cpu_seconds": 95.12345678, "stopped_early": True, "weights_hash": "2b5c",
}  # fmt: skip


def test_training_that_stopped_says_why() -> None:
    said = trained(TRAINED, out=Path("runs/line"))
    assert "250 of up to 4000: a snapshot solved every validation episode" in said
    assert "step 250     20 of 20 validation episodes solved, mean score 1.000" in said
    assert "chosen       step 250, by validation" in said
    assert "8.814 nat" in said and "95 s of CPU" in said and "this call 2 min" in said
    assert said.endswith("warp-deform eval runs/line")
    assert not re.search(r"\d\.\d{5}|None|\{|nan", said)


def test_what_there_is_not_is_not_told_of() -> None:
    plain = TRAINED | {
        "loss": None,
        "validation": {},
        "chosen": None,
        "steps": 4000,
        "stopped_early": False,
    }
    said = trained(plain, out=Path("run"))
    assert "4000, as planned" in said
    assert not {"loss", "step", "held"} & {line.split()[0] for line in said.splitlines()}
    held = trained(plain | {"held_out": {1000: 3.21456}, "left_out": 2, "demos": 1}, out=Path("r"))
    assert "loss 3.215 nat on demonstrations that were held out" in held
    assert "1 demonstration; 2 recordings left out" in held
    impatient = {2000: {"n_success": 3, "n_episodes": 20, "mean_score": 0.5}}
    stopped = TRAINED | {"patience": 2, "validation": impatient, "steps": 2000}
    assert "2 snapshots in a row brought nothing better" in trained(stopped, out=Path("r"))


def report(**changes: Any) -> dict[str, Any]:
    task = "fabric-flat-notarget"
    played = [PlayedEpisode(n, n < 15, 1.0 if n < 15 else 0.5, 3, "") for n in range(20)]
    return {
        "task": task, "agent": "goal-split", "demos": 100, "seed": 0, "selected": 3000,
        "test": summarise(played, task=task), "paper": None, "measure": "mean partial score",
        "published": 86.8,
    } | changes  # fmt: skip


def test_ours_is_ours_and_the_papers_is_the_papers() -> None:
    said = evaluated(report())
    assert "mean partial score: ours 87.5 %, the paper's 86.8 % (in another simulator)" in said
    assert "paper's value" not in said
    none = evaluated(report(published=None, demos=1))
    assert "ours 87.5 %, the paper has no number for 1 demonstration" in none
    by_theirs = report(paper={**report()["test"], "n_snapshots": 5, "stage_rule": "privileged"})
    assert "ours 87.5 %, best of 5 snapshots on 20 test episodes themselves" in evaluated(by_theirs)


def test_the_commands_say_it(
    run: RunFolder, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    data = run.read_settings()["data"]
    command = ["train", TASK, "--agent", "gt-mlp", "--data", data, "--preset", "fast",
               "--steps", "2", "--snapshots", "2", "--validate", "0",
               "--out", str(tmp_path / "new")]  # fmt: skip
    assert main(command) == 0
    said = capsys.readouterr()
    assert f"next         warp-deform eval {tmp_path / 'new'}" in said.out
    assert not re.search(r"\d\.\d{5}|None|\{", said.out)
    assert re.match(rf"train {TASK}: 1 of 2 steps, ", said.err), "off a terminal"
    assert "\x1b" not in said.err
    assert main(["eval", str(tmp_path / "new"), "--episodes", "1", "--validation-episodes", "1",
                 "--workers", "1"]) == 0  # fmt: skip
    assert "success: ours 0.0 %, the paper has no number for 2 demonstrations" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (0, "interrupted; no step is kept yet, the same command begins again"),
        (
            2,
            "interrupted; steps up to 2 are kept, the same command goes on and ends with the same "
            "bits",
        ),
    ],
)
def test_an_interrupted_training_says_which_steps_are_kept(
    stored: int,
    expected: str,
    run: RunFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before the first state is stored nothing is; afterwards all up to it."""
    steps: list[int] = []
    batch = training._batch

    def interrupting(*arguments: Any) -> Any:
        steps.append(len(steps))
        if len(steps) == stored + 3:  # the first is the rehearsal
            raise KeyboardInterrupt
        return batch(*arguments)

    monkeypatch.setattr(training, "_batch", interrupting)
    monkeypatch.setattr(training, "state_steps", lambda _: stored or 100)
    command = ["train", TASK, "--agent", "gt-mlp", "--data", run.read_settings()["data"],
               "--preset", "fast", "--steps", "8", "--snapshots", "1", "--validate", "0",
               "--out", str(tmp_path / "cut")]  # fmt: skip
    assert main(command) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"warp-deform: {expected}"
    assert RunFolder(tmp_path / "cut").read_state()[1] == stored


@pytest.mark.parametrize("verb", cli.VERBS)
def test_an_interruption_says_what_is_kept(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_dispatch", interrupted)
    assert main([verb]) == 130
    said = capsys.readouterr().err
    assert said.startswith("warp-deform: interrupted") and said.count("\n") == 1
    assert ("same command goes on" in said) is (
        verb
        in {
            "demo",
            "goals",
            "train",
            "eval",
            "sweep",
            "refine",
            "correct",
            "distill",
            "train-control",
            "demo-control",
        }
    )
    assert ("episode" in said) is (verb in {"demo", "demo-control", "refine", "correct", "franka"})


def test_labels_are_counted_beside_demonstrations() -> None:
    report = {**TRAINED, "demos": 30, "corrected": 20, "labels": 300}
    said = trained(report, out=Path("runs/line"))
    assert "10 demonstrations and 20 corrected episodes, 300 labels in all" in said


def test_what_an_agent_of_outcomes_learnt_is_no_label_and_no_likelihood() -> None:
    report = {**TRAINED, "agent": "traced", "demos": 30, "corrected": 20, "labels": 300}
    report |= {"loss": 0.07, "held_out": {40: 0.05}}
    said = trained(report, out=Path("runs/mask"))
    assert "20 corrected episodes, 300 actions in all" in said
    assert "0.070 over the last" in said and "loss 0.050 on demonstrations" in said
    assert "nat" not in said
    named = trained({**report, "agent": "transporter"}, out=Path("runs/mask"))
    assert "0.070 nat over the last" in named and "loss 0.050 nat on demonstrations" in named
