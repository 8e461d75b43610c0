"""Analytic policy gradients: bounds on derivatives, statistics, and a training that learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learning.control.actor import Actor, BoundedSlopes, RunningNorm, as_actions
from learning.control.apg import ApgConfig, play, train_apg
from warp_deform.errors import InputError, WarpDeformError

FEW = ApgConfig(updates=4, worlds=8, episodes=8)


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


def test_a_few_updates_lower_the_loss_and_the_same_seed_has_the_same_bits() -> None:
    seeds = range(8)  # those that it trains on
    before = play("whip-target", train_apg("whip-target", ApgConfig(updates=1, worlds=8,
                  episodes=8, lr=1e-12), seed=0), seeds, worlds=8)  # fmt: skip
    actor, again = (train_apg("whip-target", FEW, seed=0) for _ in range(2))
    for one, other in zip(actor.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(one, other)
    after = play("whip-target", actor, seeds, worlds=8)
    assert np.isfinite(after).all() and after.mean() < before.mean()
    assert np.array_equal(play("whip-target", actor, [5, 3], worlds=8), after[[5, 3]])


def test_what_cannot_be_trained_is_said() -> None:
    with pytest.raises(InputError, match="draws 8 of 4 episodes"):
        ApgConfig(worlds=8, episodes=4)
    with pytest.raises(InputError, match="where seeds of tests begin"):
        ApgConfig(episodes=10_001)
    with pytest.raises(InputError, match="updates has to be positive, not 0"):
        ApgConfig(updates=0)
    with pytest.raises(InputError, match="one seed or more"):
        play("whip", Actor(5), [])
    with pytest.raises(InputError, match='choose start="held"'):
        train_apg("cable-line-notarget", FEW, seed=0)


def test_a_training_that_breaks_ends_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"loss": float("nan"), "gradient": 0.0, "guards": 0.0, "unusable": 8.0, "bounded": 0.0}
    monkeypatch.setattr("learning.control.apg.apg_update", lambda *_, **__: told)
    with pytest.raises(WarpDeformError, match="no number after 1 updates"):
        train_apg("whip-target", FEW, seed=0)
