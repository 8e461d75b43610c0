"""From an arm's demonstrations to a policy that moves it: the commands of docs/hardware.md."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from warp_deform.command.main import main


def run(capfd: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    assert main([*arguments, "--json"]) == 0, capfd.readouterr().err
    found: dict[str, object] = json.loads(capfd.readouterr().out.splitlines()[-1])
    return found


def test_a_traced_policy_learns_from_an_arms_episodes_and_moves_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    demos, policy, sim = tmp_path / "demos", tmp_path / "policy", ("--robot", "sim")
    made = run(capfd, "franka", "collect", "-n", "2", *sim, "--agent", "scripted", "--seed", "2",
               "--out", str(demos))  # fmt: skip
    assert made["demonstrations"] == 2
    trained = run(capfd, "train", "cable-mask-goal", "--agent", "traced", "--preset", "fast",
                  "--data", str(demos), "--demos", "1", "--hold-out", "1", "--steps", "3",
                  "--batch", "4", "--out", str(policy))  # fmt: skip
    assert trained["demos"] == 1 and trained["steps"] == 3
    played = run(capfd, "franka", "run", *sim, "--agent", "policy", "--policy", str(policy),
                 "--max-actions", "1", "--seed", "9",
                 "--out", str(tmp_path / "played"))  # fmt: skip
    assert played["actions"] == 1 and played["outcomes"] == ["placed"]
