"""Policies that are handed on are small, have a result on the present tasks, and play."""

from __future__ import annotations

import json
import sys

import pytest
from fixtures.places import ROOT

from learning.policy.policy import load_policy
from warp_deform.tasks.registration import env_id

sys.path.insert(0, str(ROOT / "benchmarks"))

import handed_on

NAMES = sorted(folder.name for folder in handed_on.POLICIES.iterdir())
MOST = 1_500_000
"""Bytes of weights: a policy is cloned with the project."""


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_is_small_and_has_a_result_of_its_task_as_it_is(name: str) -> None:
    row = handed_on.read(handed_on.ROWS)[name]
    run = json.loads((handed_on.POLICIES / name / "run.json").read_text())
    weights = list((handed_on.POLICIES / name / "snapshots").glob("*.safetensors"))
    assert row["environment"] == env_id(run["agent"]["task"])
    assert len(weights) == 1 and weights[0].stat().st_size == row["bytes"] <= MOST
    assert not row["revision"]["dirty"] and row["n_episodes"] >= 100
    assert load_policy(handed_on.POLICIES / name).description.agent == row["agent"]


def test_no_result_is_without_its_policy() -> None:
    assert sorted(handed_on.read(handed_on.ROWS)) == NAMES


def test_a_policy_plays_as_it_is(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, out = "block-notarget-goal-split-100", tmp_path / "rows.jsonl"
    before = sorted((handed_on.POLICIES / name).rglob("*"))
    arguments = ["--policies", name, "--episodes", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["handed_on.py", *arguments])
    handed_on.main()
    row = handed_on.read(out)[name]
    assert row["n_success"] == row["n_episodes"] == 2 and row["demos"] == 100
    assert sorted((handed_on.POLICIES / name).rglob("*")) == before
    monkeypatch.setattr(handed_on, "played", lambda *_: pytest.fail("it has a row"))
    handed_on.main()
