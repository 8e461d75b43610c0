"""A network that plans a swing at once: it learns, plays what it planned, and is for swings."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learning.control.actor import PlanActor
from learning.control.plan import PlanConfig, PlanLearner
from learning.control.play import play_control
from warp_deform.control import TensorControlWorlds
from warp_deform.errors import InputError


@pytest.fixture(scope="module")
def worlds() -> TensorControlWorlds:
    return TensorControlWorlds("whip-target", 8, action_penalty=0.0)


def trained(worlds: TensorControlWorlds, updates: int) -> PlanLearner:
    learner = PlanLearner(worlds, PlanConfig(lr=2e-3), episodes=8, updates=updates, seed=0)
    for number in range(1, updates + 1):
        learner.update(number)
    return learner


def test_it_learns_and_the_same_seed_has_the_same_bits(worlds: TensorControlWorlds) -> None:
    before = play_control(worlds, trained(worlds, 0).actor, range(8)).left
    learners = [trained(worlds, 30) for _ in range(2)]
    one, other = (learner.tensors() for learner in learners)
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    after = play_control(worlds, learners[0].actor, range(8)).left
    assert after.mean() < 0.5 * before.mean()


def test_what_is_played_is_what_was_planned(worlds: TensorControlWorlds) -> None:
    learner = trained(worlds, 2)
    with torch.no_grad():
        plans = learner.actor.plans(learner._first).double().numpy()
    losses = learner._problem.evaluate(plans[:, None])[:, 0]
    assert play_control(worlds, learner.actor, range(8)).left == pytest.approx(losses, abs=1e-3)


def test_one_wild_episode_moves_the_weights_no_more_than_a_tame_one(
    worlds: TensorControlWorlds, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Directions count, so that what is 10,000 times as long changes no bit, and no number none."""
    tame, wild, broken = (trained(worlds, 0) for _ in range(3))
    gradients = type(tame._problem).gradients

    def scaled(factor: float):
        def changed(self, numbers, goals):
            losses, found = gradients(self, numbers, goals)
            found = found.copy()
            found[3] *= factor
            return losses, found

        return changed

    told = []
    for learner, factor in ((tame, 1.0), (wild, 2.0**14), (broken, np.nan)):
        learner.updates = 1
        monkeypatch.setattr(type(tame._problem), "gradients", scaled(factor))
        told.append(learner.update(1))
    one, other, third = (learner.tensors() for learner in (tame, wild, broken))
    assert all(torch.equal(one[k], other[k]) for k in one)
    assert all(bool(third[k].isfinite().all()) for k in third)
    assert [each["unusable"] for each in told] == [0, 0, 1]
    assert not all(torch.equal(one[k], third[k]) for k in one)


def test_a_row_that_begins_again_gets_a_plan_of_its_own() -> None:
    actor = PlanActor(4, (8,), steps=5)
    with torch.no_grad():
        for each in actor.network.parameters():
            each.normal_()
    first = torch.randn(3, 4)
    first[:, -1] = 0.0
    with pytest.raises(InputError, match="begins with its episode"):
        actor(first + 0.4)
    plans = actor.plans(first)
    assert torch.equal(actor(first)[:, 3], torch.ones(3)), "it keeps hold"
    later = torch.randn(3, 4)
    later[:, -1] = torch.tensor([0.4, 0.0, 0.4])
    acts = actor(later)
    fresh = actor.plans(later)[1, 0]
    for row, moves in ((0, plans[0, 2]), (1, fresh), (2, plans[2, 2])):
        assert torch.allclose(acts[row, :3], moves / (1 + (moves**2).sum()).sqrt())


@pytest.mark.parametrize(
    ("task", "options", "match"),
    [
        ("cable-line-notarget", {"start": "held"}, "is for swings.*cable-line-notarget is none"),
        ("whip", {"horizon": 7}, "20 steps long, not 7: leave --horizon out"),
    ],
)
def test_what_it_cannot_plan_is_refused(task: str, options: dict, match: str) -> None:
    others = TensorControlWorlds(task, 8, action_penalty=0.0, **options)
    with pytest.raises(InputError, match=match):
        PlanLearner(others, PlanConfig(), episodes=8, updates=1, seed=0)
