"""The comparison of policies of control: what PPO is given, and what is told of goals."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import control_policies as policies

from learning.control.play import PlayedControl
from warp_deform.control import TensorControlWorlds


def test_lanes_begin_again_where_they_end_and_pay_progress() -> None:
    worlds = TensorControlWorlds("whip-target", 8, horizon=2, action_penalty=0.0)
    lanes = policies.Lanes(worlds, seed=0)
    seen = lanes.reset()
    assert seen.shape == (8, *lanes.observation_space.shape) and not seen[:, -1].any()
    rng = np.random.default_rng(0)
    for turn in range(2):
        first = worlds.left.clone()
        paid = np.zeros(8)
        for step in range(2):
            moves = rng.uniform(-1, 1, (8, 3))
            moves[:, 2] = 0.5  # off the table, where nothing presses
            before = [worlds.worlds.episodes[slot].seed for slot in range(8)]
            seen, rewards, over, infos = lanes.step(moves)
            paid += rewards
            assert over.all() == (step == 1), (turn, step)
        last = np.stack([info["terminal_observation"] for info in infos])
        assert (last[:, -1] == 1.0).all() and not seen[:, -1].any(), "time is seen"
        after = [worlds.worlds.episodes[slot].seed for slot in range(8)]
        assert before != after and max(after) < policies.EPISODES
        assert (paid < 1.0).all() and torch.isfinite(first).all()
    # the same moves, played plainly, pay the same
    worlds.reset(dict(enumerate(after)))
    start = worlds.left.clone()
    rewards = np.zeros(8)
    with torch.no_grad():
        for moves in np.full((2, 8, 3), 0.4):
            worlds.advance(policies.with_hold(torch.from_numpy(moves)))
    progress = ((start - worlds.left) / start).numpy()
    lanes.worlds.reset(dict(enumerate(after)))
    lanes._draw = lambda slots: {int(slot): 0 for slot in slots}  # type: ignore[method-assign]
    for moves in np.full((2, 8, 3), 0.4):
        rewards += lanes.step(moves)[1]
    assert rewards == pytest.approx(progress, abs=1e-5)


def test_a_fired_guard_counts_as_missed() -> None:
    left = np.array([0.005, 0.015, 0.04, 0.09, 0.3, np.inf])
    scores = np.array([0.9, 0.6, 0.2, 0.1, 0.0, 0.0])
    row = policies.told(PlayedControl(left, scores, np.array([True, True, *[False] * 4])))
    assert [row[f"within_{cm}_cm"] for cm in (10, 5, 2, 1)] == [4, 3, 2, 1]
    assert (row["goals"], row["guards"], row["solved"]) == (6, 1, 2)
    assert row["mean_cm"] == pytest.approx(9.0) and row["score"] == pytest.approx(0.3)
    assert row["mean_cm_low"] < 9.0 < row["mean_cm_high"]
    assert row["score_low"] < 0.3 < row["score_high"]
