"""A policy demonstrates: what it solves is a dataset, the same in any company and after a kill."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from learning.control.cloning import read_chunks
from learning.control.demonstrate import POLICY, demonstrate
from learning.control.train import ControlTrainConfig, train_control
from warp_deform.collecting.replay import verify
from warp_deform.command.main import main
from warp_deform.control.registry import control_task
from warp_deform.episodes import EpisodeReader, EpisodeWriter, combine_hashes
from warp_deform.errors import InputError

TASK, EPISODES = "whip-target", 10
"""More than there are lanes, so that slots are used again."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that plans, and has learnt next to nothing."""
    out = tmp_path_factory.mktemp("run")
    few = {"worlds": 8, "episodes": 8, "updates": 2, "snapshots": 1, "validate": 8}
    train_control(ControlTrainConfig(task=TASK, method="plan", out=out, progress=False, **few))  # type: ignore[arg-type]
    return out


@pytest.fixture
def all_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(control_task(TASK)), "success_score", 0.0)


def last_score(reader: EpisodeReader, seed: int) -> float:
    return reader.read(seed).steps[-1].score


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


def test_what_is_solved_replays_and_can_be_cloned(
    run: Path,
    tmp_path: Path,
    all_solved: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "demos"
    assert main(["demo-control", str(run), "-n", str(EPISODES), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["task"], report["episodes"], report["solved"]) == (TASK, EPISODES, EPISODES)
    reader = EpisodeReader(out, control=True)
    assert report["state_hash"] == combine_hashes(info.state_hash for info in reader.infos())
    assert report["mean_score"] == pytest.approx(
        np.mean([last_score(reader, k) for k in reader.seeds])
    )
    assert reader.seeds == tuple(range(EPISODES))
    assert {info.demonstrator for info in reader.infos()} == {POLICY}
    replayed = verify(out, workers=1)
    assert (replayed["episodes"], replayed["mismatches"]) == (EPISODES, 0)
    chunks = read_chunks(out, 10)
    assert len(chunks.seen) == sum(info.actions for info in reader.infos()) > EPISODES

    write, written = EpisodeWriter.write, []

    def interrupted(self: EpisodeWriter, episode: object) -> Path:
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(write(self, episode))  # type: ignore[arg-type]
        return written[-1]

    monkeypatch.setattr(EpisodeWriter, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        demonstrate(run, tmp_path / "again", episodes=EPISODES, progress=False)
    monkeypatch.setattr(EpisodeWriter, "write", write)
    assert len(files(tmp_path / "again")) == 3
    demonstrate(run, tmp_path / "again", episodes=EPISODES, progress=False)
    assert files(tmp_path / "again") == files(out)


def test_what_cannot_be_is_refused_and_leaves_nothing(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demos"
    assert main(["demo-control", str(run), "-n", "2", "--out", str(out)]) == 2
    assert "solves none of 2 episodes; train it for longer" in capsys.readouterr().err
    for wrong in (0, 10_001):
        with pytest.raises(InputError, match="it must be 1 to 10000"):
            demonstrate(run, tmp_path / "other", episodes=wrong, progress=False)
    with pytest.raises(InputError):
        demonstrate(tmp_path, tmp_path / "other", episodes=2, progress=False)
    assert not (tmp_path / "other").exists() and not files(out)
