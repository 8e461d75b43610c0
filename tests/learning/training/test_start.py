"""Training that starts from weights: those of networks that see the same mean the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.training_samples import write_demonstrations

from learning.policy.policy import load_policy
from learning.runs.folder import read_snapshot
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.start import begin
from learning.training.train import train
from warp_deform.errors import InputError

SHORT = Schedule(steps=2, batch=4, lr=1e-3, snapshots=1)


@pytest.mark.parametrize("exact", [False, True])
def test_weights_of_before_fit_where_cosines_are_seen_alike(
    exact: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Snapshots of before do not say how they see cosines; they see them whole."""
    data = write_demonstrations(tmp_path / "demos", 2)

    def config(out: str, **changes: Any) -> TrainConfig:
        return TrainConfig(
            task="cable-line-notarget", agent="gt-mlp", preset="fast", schedule=SHORT,
            exact=exact, data=data, demos=2, out=tmp_path / out, progress=False, **changes,
        )  # fmt: skip

    def older(snapshot: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        weights, record = read_snapshot(snapshot)
        del record["agent"]["config"]["cosines_less_one"]
        return weights, record

    train(config("first"))
    description = load_policy(tmp_path / "first").description
    again = config("again", start=tmp_path / "first")
    assert begin(again, description)[1] is not None
    monkeypatch.setattr("learning.training.start.read_snapshot", older)
    if exact:
        assert begin(again, description)[1] is not None
    else:
        with pytest.raises(InputError, match="has another cosines_less_one than this run"):
            begin(again, description)
