"""Short-horizon actor-critic: returns in closed form, where the graph ends, what is learnt."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from learning.control.shac import Critic, Shac, ShacConfig, td_lambda
from warp_deform.control import TensorControlWorlds
from warp_deform.control.tensor_worlds import TensorStep
from warp_deform.errors import InputError

FEW = ShacConfig(window=2, passes=2, batches=2)


@pytest.fixture(scope="module")
def worlds() -> TensorControlWorlds:
    return TensorControlWorlds("whip-target", 8, action_penalty=0.0, horizon=4)


def mixed(rewards: np.ndarray, values: np.ndarray, discount: float, trace: float) -> np.ndarray:
    """The lambda-return as its definition has it: a weighted sum of all n-step returns."""
    count = len(rewards)
    out = np.zeros_like(rewards)
    for t in range(count):
        steps = [
            sum(discount**k * rewards[t + k] for k in range(n)) + discount**n * values[t + n - 1]
            for n in range(1, count - t + 1)
        ]
        weights = [(1 - trace) * trace**k for k in range(len(steps) - 1)]
        out[t] = sum(w * g for w, g in zip(weights, steps[:-1], strict=True))
        out[t] += trace ** (len(steps) - 1) * steps[-1]
    return out


@pytest.mark.parametrize("trace", [0.0, 0.7, 0.95, 1.0])
def test_returns_are_the_weighted_sum_of_all_n_step_returns(trace: float) -> None:
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, 6, 3))
    rewards[4:, 1] = values[3:, 1] = 0.0  # over after the fourth step
    found = td_lambda(
        torch.from_numpy(rewards), torch.from_numpy(values), discount=0.9, trace=trace
    ).numpy()
    assert found == pytest.approx(mixed(rewards, values, 0.9, trace))
    assert found[3, 1] == pytest.approx(rewards[3, 1]) and not found[4:, 1].any()


def test_returns_of_a_steady_reward_have_the_geometric_sum() -> None:
    ones = torch.ones(5, 1)
    worth = torch.full((5, 1), 1 / (1 - 0.9))  # of a reward of 1 for ever
    for trace in (0.0, 0.5, 1.0):
        found = td_lambda(ones, worth, discount=0.9, trace=trace)
        assert found.numpy() == pytest.approx(10.0)


def test_the_graph_ends_with_the_window(
    worlds: TensorControlWorlds, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[torch.Tensor] = []
    linked: list[bool] = []
    advance = worlds.advance

    def watched(actions: torch.Tensor) -> TensorStep:
        linked.append(worlds.observe().requires_grad)
        actions.retain_grad()
        taken.append(actions)
        return advance(actions)

    learner = Shac(worlds, FEW, episodes=8, updates=2, seed=0)
    monkeypatch.setattr(worlds, "advance", watched)
    learner.update(1)
    assert linked == [False, True, False, True]
    slopes = [each.grad for each in taken]
    assert all(each is not None and each.any(dim=1).all() for each in slopes)
    # the last action of the first window has the derivative of its reward and of the value after
    # it: with a critic that says 0 that of its reward alone, whatever the second window earned
    with torch.no_grad():
        for part in learner.target.parameters():
            part.zero_()
    taken.clear()
    learner.update(2)
    monkeypatch.undo()
    actions = [each.detach().requires_grad_() for each in taken]
    rng = np.random.default_rng([17, 0, 2])
    worlds.reset(dict(enumerate(rng.choice(8, 8, replace=False).tolist())))
    worlds.advance(actions[0])
    reward = worlds.advance(actions[1]).rewards
    (alone,) = torch.autograd.grad(reward.mean(), actions[1])
    found = taken[1].grad
    assert found is not None
    assert (-found).numpy() == pytest.approx(alone.numpy(), rel=1e-3, abs=1e-7)


def test_the_same_seed_has_the_same_bits_and_goes_on_from_its_tensors(
    worlds: TensorControlWorlds,
) -> None:
    whole = Shac(worlds, FEW, episodes=8, updates=4, seed=0)
    for number in (1, 2, 3, 4):
        told = whole.update(number)
    assert np.isfinite(list(told.values())).all() and told["guards"] == 0
    begun = Shac(worlds, FEW, episodes=8, updates=4, seed=0)
    for number in (1, 2):
        begun.update(number)
    later = Shac(worlds, FEW, episodes=8, updates=4, seed=1)  # other weights, soon overwritten
    later.restore(begun.tensors())
    later.seed = 0
    for number in (3, 4):
        later.update(number)
    one, other = whole.tensors(), later.tensors()
    assert one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)
    assert not torch.equal(
        one["critic.network.0.weight"], begun.tensors()["critic.network.0.weight"]
    )
    with pytest.raises(InputError, match="another kind of training"):
        later.restore({**one, "adam.further.0.step": torch.zeros(())})
    with pytest.raises(InputError, match="weights of actor are missing"):
        later.restore({})


def test_the_critic_learns_what_it_is_shown(worlds: TensorControlWorlds) -> None:
    config = ShacConfig(window=2, passes=200, batches=2)
    learner = Shac(worlds, config, episodes=8, updates=1, seed=0)
    states = torch.randn(40, next(learner.critic.parameters()).shape[1])
    returns = states[:, 0]
    before = float(((learner.critic(states) - returns).detach() ** 2).mean())
    after = learner._teach(states, returns, torch.Generator().manual_seed(0))
    assert after < 0.1 * before
    assert Critic(5)(torch.zeros(3, 2, 5)).shape == (3, 2)


def test_settings_out_of_range_are_refused() -> None:
    for name, value in (("window", 0), ("discount", 1.1), ("keep", 1.0), ("noise", 0.0)):
        with pytest.raises(InputError, match=f"ShacConfig.{name} must be"):
            ShacConfig(**{name: value})
