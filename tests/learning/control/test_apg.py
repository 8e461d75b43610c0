"""Analytic policy gradients: bounds on derivatives, statistics, and a training that learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learning.control.actor import Actor, BoundedSlopes, RunningNorm, as_actions
from learning.control.apg import Apg, ApgConfig
from learning.control.play import play_control
from warp_deform.control import TensorControlWorlds
from warp_deform.errors import InputError


@pytest.fixture(scope="module")
def worlds() -> TensorControlWorlds:
    return TensorControlWorlds("whip-target", 8, action_penalty=0.0)


def test_statistics_are_those_of_all_that_was_shown() -> None:
    seen = torch.from_numpy(np.random.default_rng(0).normal(3.0, 2.0, (7, 50, 4)))
    norm = RunningNorm(4)
    for part in seen:
        norm.update(part)
    rows = seen.reshape(-1, 4)
    assert torch.allclose(norm.mean, rows.mean(dim=0))
    normal = norm(rows)
    assert torch.allclose(normal.mean(dim=0), torch.zeros(4), atol=1e-5)
    assert torch.allclose(normal.std(dim=0, correction=0), torch.ones(4), atol=1e-4)


def test_one_wild_world_is_bounded_and_what_is_no_number_is_counted() -> None:
    hook = BoundedSlopes(0.5, share=0.25)
    slopes = torch.tensor([[0.03, 0.04], [300.0, 400.0], [float("nan"), 1.0], [0.0, 0.0]])
    out = hook(slopes)
    assert out[0].tolist() == slopes[0].tolist()
    assert out[1].numpy() == pytest.approx([0.075, 0.1])
    assert not out[2:].any() and hook.unusable == 1 and hook.bounded == 1


def test_actions_are_never_longer_than_a_tip_goes_and_keep_hold() -> None:
    actions = as_actions(torch.randn(100, 3) * 50)
    assert (actions[:, :3].norm(dim=1) < 1 + 1e-6).all() and (actions[:, 3] == 1).all()
    lifted = Actor(5)(torch.zeros(2, 5))
    assert (lifted[:, 2] > 0.3).all(), "before training it lifts"


def test_a_few_updates_lower_the_loss_and_the_same_seed_has_the_same_bits(
    worlds: TensorControlWorlds,
) -> None:
    learners = [Apg(worlds, ApgConfig(), episodes=8, updates=4, seed=0) for _ in range(2)]
    before = play_control(worlds, learners[0].actor, range(8))  # the seeds that it trains on
    for learner in learners:
        for number in range(1, 5):
            learner.update(number)
    one, other = (learner.tensors() for learner in learners)
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    after = play_control(worlds, learners[0].actor, range(8))
    assert np.isfinite(after.left).all() and after.left.mean() < before.left.mean()
    some = play_control(worlds, learners[0].actor, [5, 3])
    assert np.array_equal(some.left, after.left[[5, 3]])
    assert np.array_equal(some.scores, after.scores[[5, 3]])


def test_what_cannot_be_trained_or_played_is_said(worlds: TensorControlWorlds) -> None:
    with pytest.raises(InputError, match="lr must be a number above 0, got 0"):
        ApgConfig(lr=0)
    with pytest.raises(InputError, match="one seed or more"):
        play_control(worlds, Actor(5), [])
