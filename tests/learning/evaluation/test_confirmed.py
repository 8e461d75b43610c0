"""Of snapshots that solved all that every snapshot plays, the further episodes decide."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from learning.evaluation.protocol import Protocol
from learning.evaluation.run import evaluate_run
from learning.evaluation.snapshot import confirmed, evaluate_snapshot
from learning.evaluation.summary import Evaluation, PlayedEpisode, best, summarise
from learning.runs.folder import RunFolder
from learning.training.processes import Process
from learning.training.validation import Validation

EVERY = Protocol(split="validation", episodes=2)
FURTHER = 4
SOLVED_FURTHER = {1: 1, 2: 4}
"""Of the further episodes, how many each step solves."""


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> RunFolder:
    """A run of which both snapshots solve all; the first in fewer actions, but not the further."""
    shutil.copytree(trained.parent, tmp_path, dirs_exist_ok=True)
    made = RunFolder(tmp_path / "run")
    settings = made.read_settings()
    settings |= {"validate": 2, "schedule": {**settings["schedule"], "confirm": FURTHER}}
    (made.path / "run.json").write_text(json.dumps(settings))
    longer = replace(EVERY, episodes=EVERY.episodes + FURTHER)
    for step, solved in SOLVED_FURTHER.items():
        evaluate_snapshot(made, step, longer)
        (path,) = made.evaluations.glob(f"step_{step:08d}-*.json")
        record = json.loads(path.read_text())
        for n, episode in enumerate(record["episodes"]):
            good = n < EVERY.episodes + solved
            episode |= {"success": good, "score": float(good), "actions": step}
            episode["failure"] = None if good else "other"
        path.write_text(json.dumps(record))
    return made


def test_eval_takes_the_snapshot_that_was_confirmed(run: RunFolder) -> None:
    report = evaluate_run(run.path, episodes=1, validation_episodes=2, workers=1, progress=False)
    assert [report["snapshots"][step]["pc_success"] for step in ("1", "2")] == [100.0, 100.0]
    assert report["selected"] == 2
    assert [confirmed(run, step, EVERY) for step in (1, 2)] == [0.25, 1.0]


def test_training_takes_the_same_snapshot(run: RunFolder) -> None:
    alone = Process(0, 1, torch.device("cpu"))
    validation = Validation(
        run, episodes=2, confirm=FURTHER, process=alone, trained=(), goals=(), task="block-notarget"
    )
    validation.evaluate([1])
    assert validation.chosen == 1
    validation.evaluate([2])
    assert validation.chosen == 2
    assert [each["n_success"] for each in validation.results.values()] == [3, 6]


def test_what_was_played_in_part_or_for_nothing_confirms_nothing(run: RunFolder) -> None:
    for name, change in (("part", lambda rows: rows[:-1]), ("failed", spoil_first)):
        (path,) = run.evaluations.glob("step_00000002-validation-*.json")
        record = json.loads(path.read_text())
        (run.path / name).write_text(path.read_text())
        path.write_text(json.dumps({**record, "episodes": change(record["episodes"])}))
        assert confirmed(run, 2, EVERY) == 0.0
        path.write_text((run.path / name).read_text())
    assert confirmed(run, 2, EVERY) == 1.0


def spoil_first(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Results of which the first one failed."""
    return [{**rows[0], "success": False, "failure": "other"}, *rows[1:]]


def test_what_training_does_not_play_confirms_nothing(run: RunFolder) -> None:
    assert confirmed(run, 2, replace(EVERY, episodes=3)) == 0.0
    assert confirmed(run, 2, replace(EVERY, retry=False)) == 0.0
    settings = run.read_settings()
    del settings["schedule"]["confirm"]  # of a release that had none
    (run.path / "run.json").write_text(json.dumps(settings))
    assert confirmed(run, 2, EVERY) == 0.0
    report = evaluate_run(run.path, episodes=1, validation_episodes=2, workers=1, progress=False)
    assert report["selected"] == 1, "of equals the one with fewer actions"


def test_further_episodes_decide_among_equals_alone() -> None:
    def made(step: int, **episode: Any) -> Evaluation:
        played = (PlayedEpisode(0, True, 1.0, 3, "", None), PlayedEpisode(1, **episode))
        return Evaluation(step, played, summarise(played, task="cable-ring"))

    good = {"success": True, "score": 1.0, "actions": 3, "reason": "", "failure": None}
    poor = {"success": False, "score": 0.0, "actions": 9, "reason": "", "failure": "other"}
    evaluations = [made(1, **good), made(2, **good), made(3, **poor)]
    further = {1: 0.9, 2: 0.8, 3: 1.0}
    assert best(evaluations, task="cable-ring", confirmed=further).step == 1
    assert best(evaluations, task="cable-ring", confirmed={}).step == 2, "of equals the latest"
