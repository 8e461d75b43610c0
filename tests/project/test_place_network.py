"""benchmarks/place_network.py: what it calls solved, and that its networks learn to place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fixtures.benchmark_scripts import benchmark

from learning.models.gt_state import GtState, GtStateConfig


@pytest.fixture
def script() -> Iterator[Any]:
    with benchmark("place_network") as module:
        yield module


@pytest.mark.parametrize(
    ("column", "amiss", "share"),
    [
        (0, 0.0, 1.0),
        (3, 0.009, 1.0),
        (3, 0.011, 0.0),
        (5, 0.25, None),  # 14 degrees about the pick: the block's origin moves along
        (5, 0.27, 0.0),
        (0, 0.2, 0.0),
    ],
)
def test_what_is_solved_is_what_the_task_calls_so(
    script: Any, monkeypatch: pytest.MonkeyPatch, column: int, amiss: float, share: float | None
) -> None:
    state, truth = script.scenes(300, np.random.default_rng(0))
    action = truth.copy()
    action[:, column] += amiss
    agent = GtState(6, GtStateConfig(), seed=0)
    monkeypatch.setattr(agent, "act", lambda state, rng: action)
    solved = script.placed(agent, state, truth, rng=np.random.default_rng(0)).mean()
    assert solved == share if share is not None else 0.05 < solved < 0.95


def test_longer_steps_bring_the_place_network_on(script: Any) -> None:
    short, long = (
        script.measure("gt-mlp-2step", 100, lr, 400, exact=False)["n_success"]
        for lr in (2e-4, 1e-3)
    )
    assert long > 30 > short
