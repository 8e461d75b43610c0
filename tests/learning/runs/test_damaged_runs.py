"""Files of a run that are valid JSON and say something else: one line each, never a traceback."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.short_runs import SHORT, TASK, said, settle

from learning.evaluation.snapshot import evaluate_snapshot
from learning.evaluation.protocol import Protocol
from learning.evaluation.run import evaluate_run
from learning.evaluation.share import share_run
from learning.policy.policy import load_policy
from learning.runs.folder import RunFolder, read_json, write_json
from warp_deform.errors import InputError

SPOILT_RECORDS: list[Any] = [
    {},
    {"format": 1},
    {"format": 1, "step": 2, "agent": "x"},
    {"format": 1, "step": 2, "agent": {"task": TASK, "agent": "gt-mlp"}},
    {"format": 1, "step": 2, "agent": {"task": TASK, "agent": "gt-mlp", "config": "x"}},
    {"format": 1, "step": 2, "agent": {"task": [], "agent": "gt-mlp", "config": {}}},
    {"format": 1, "step": 2, "agent": {"task": TASK, "agent": "gt-mlp", "config": {}}},
    {"format": 1, "step": 2, "agent": {"task": TASK, "agent": "no", "config": {}}},
    {"format": 1, "step": 2,
     "agent": {"task": TASK, "agent": "gt-mlp", "config": {"lifts": 5}, "state_size": 6}},
    {"format": 1, "step": 2,
     "agent": {"task": TASK, "agent": "gt-mlp", "config": {"lifts": ["a"]}, "state_size": "b"}},
    {"format": 1, "step": 2,
     "agent": {"task": TASK, "agent": "gt-mlp", "config": {}, "state_size": 6, "more": 1}},
    [1],
]  # fmt: skip


@pytest.mark.parametrize("record", SPOILT_RECORDS, ids=lambda record: json.dumps(record)[-40:])
def test_a_damaged_record_of_a_snapshot_is_one_line(
    run: RunFolder, capsys: pytest.CaptureFixture[str], record: Any
) -> None:
    for step in run.steps():
        run.snapshot(step).with_suffix(".json").write_text(json.dumps(record))
    said(capsys, "eval", str(run.path), *SHORT)
    with pytest.raises(InputError) as error:
        load_policy(run.path)
    assert "\n" not in str(error.value) and "step_00000002" in str(error.value)


@pytest.mark.parametrize(
    "changes",
    [
        None,
        {"agent": None},
        {"agent": {}},
        {"agent": {"task": TASK, "agent": "gt-mlp", "config": "x"}},
        {"preset": 1},
        {"schedule": []},
        {"schedule": {"steps": "many"}},
        {"seed": "a"},
        {"demonstrations": [0]},
        {"demonstrations": {"a": "b"}},
        {"patience": "long"},
        {"validate": True},
        {"demonstrators": "scripted"},
        {"versions": "new"},
    ],
    ids=json.dumps,
)
def test_damaged_settings_of_a_run_are_one_line(
    run: RunFolder,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, Any] | None,
) -> None:
    if changes is None:
        run.settings.write_text("{}")
    else:
        settle(run, **changes)
    assert "run.json" in said(capsys, "eval", str(run.path), *SHORT)
    for use in (load_policy, lambda path: share_run(path, tmp_path / "shared")):
        with pytest.raises(InputError, match=r"run\.json"):
            use(run.path)
    assert not (tmp_path / "shared").exists()


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"episodes": 3}',
        '{"episodes": [3]}',
        '{"episodes": [{"seed": 50000}]}',
        '{"episodes": [{"seed": 50000, "success": false, "score": 0.0, "actions": 1, "reason": "",'
        ' "goal_l2": ["a"]}]}',
    ],
)
def test_damaged_results_are_one_line(
    run: RunFolder, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    evaluate_snapshot(run, 1, Protocol(split="validation", episodes=1))
    (path,) = run.evaluations.iterdir()
    path.write_text(text)
    assert "remove it" in said(capsys, "eval", str(run.path), *SHORT)


def test_a_damaged_report_is_not_taken_for_none(run: RunFolder) -> None:
    evaluate_run(run.path, episodes=1, validation_episodes=1, workers=1, progress=False)
    whole = read_json(run.report)
    for changes, expected in (
        ({"selected": None}, "selected"),
        ({"selected": 7}, "step 7, of which there is no snapshot"),
    ):
        write_json(run.report, {**whole, **changes})
        with pytest.raises(InputError, match=expected):
            load_policy(run.path)


def test_a_flipped_bit_of_the_weights_is_seen(
    run: RunFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run.snapshot(2)
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1
    path.write_bytes(whole)
    with pytest.raises(InputError, match="is damaged: these are not the weights"):
        load_policy(run.path)
    assert "step_00000002.safetensors is damaged" in said(capsys, "eval", str(run.path), *SHORT)
