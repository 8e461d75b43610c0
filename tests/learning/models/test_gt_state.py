"""The ground-truth baselines: mixtures against closed forms, and what the networks learn."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from learning.models.adam import KerasAdam
from learning.models.gt_state import (
    GtState,
    GtState2Step,
    GtStateConfig,
    LiftMLP,
    Mixture,
    encode_action,
    mixture_loss,
    sample_mixture,
)
from learning.policy.policy import AgentDescription, make_agent
from warp_deform.errors import InputError

AGENTS = (GtState, GtState2Step)
WHOLE = GtStateConfig(yaws=(2,), cosines_less_one=False)


def mixture(seed: int = 0, batch: int = 4, k: int = 3, d: int = 2) -> Mixture:
    g = torch.Generator().manual_seed(seed)
    weights = torch.rand(batch, k, generator=g)
    return Mixture(
        (weights / weights.sum(dim=1, keepdim=True)).log(),
        torch.randn(batch, k, d, generator=g),
        0.3 + torch.rand(batch, k, generator=g),
    )


@pytest.mark.parametrize("exact", [False, True])
def test_loss_is_the_mixture_s_negative_log_likelihood(exact: bool) -> None:
    mix, target = mixture(), torch.linspace(-1, 1, 8).reshape(4, 2)
    pi, mean, variance = mix.log_pi.exp().numpy(), mix.mean.numpy(), mix.variance.numpy()
    expected = [
        -math.log(
            sum(
                pi[b, k] * multivariate_normal.pdf(target[b], mean[b, k], variance[b, k])
                for k in range(3)
            )
        )
        for b in range(4)
    ]
    assert float(mixture_loss(mix, target, exact=exact)) == pytest.approx(
        np.mean(expected), rel=1e-5
    )


def test_only_the_exact_loss_is_clipped_far_away() -> None:
    mix = mixture()
    mean = mix.mean.clone().requires_grad_()
    far = torch.full((4, 2), 40.0)
    clipped = mixture_loss(mix._replace(mean=mean), far, exact=True)
    assert float(clipped.detach()) == pytest.approx(-math.log(1e-8), rel=1e-5)
    clipped.backward()
    assert mean.grad is not None
    assert not mean.grad.any()
    mixture_loss(mix._replace(mean=mean), far).backward()
    assert mean.grad.abs().max() > 1


def test_samples_have_the_sharpened_variance() -> None:
    mix = Mixture(
        torch.tensor([[0.0, -50.0]]).expand(4000, -1),
        torch.tensor([[[1.0, -2.0], [9.0, 9.0]]]).expand(4000, -1, -1),
        torch.tensor([[0.5, 1.0]]).expand(4000, -1),
    )
    draws = sample_mixture(mix, rng=np.random.default_rng(0))
    assert draws.mean(axis=0) == pytest.approx([1.0, -2.0], abs=0.02)
    assert draws.var(axis=0) == pytest.approx([0.5**4] * 2, rel=0.1)


def test_parameter_counts() -> None:
    d, hidden, k = 147, 128, 26
    features = hidden + 3 * d
    body = (3 * d + 1) * hidden + (features + 1) * hidden
    one = GtState(d, GtStateConfig(), seed=0)
    assert sum(p.numel() for p in one.parameters()) == body + (features + 1) * (6 * k + 2 * k)
    assert float(one.network.first.weight.detach().std()) == pytest.approx(0.05, rel=0.02)
    assert float(one.network.first.bias.detach().std()) == pytest.approx(0.05, rel=0.3)


@pytest.mark.parametrize(("exact", "same"), [(False, True), (True, False)])
def test_a_whole_turn_is_seen_as_none(exact: bool, same: bool) -> None:
    """But for the raw -yaw / 15, whose weights are taken out; the original's sines tell a turn."""
    agent = GtState(3, GtStateConfig(yaws=(2,), exact=exact), seed=0)
    network = agent.network
    for layer in (network.first, network.second, network.mean, network.mixing):
        layer.weight.data[:, -9:-6] = 0
    state = torch.tensor([[0.5, 0.1, -1.0 / 15]])
    turned = state - torch.tensor([0.0, 0.0, 2 * math.pi / 15])
    before, after = (network(each).mean for each in (state, turned))
    assert torch.allclose(before, after, atol=1e-5) is same


@pytest.mark.parametrize("agent_class", AGENTS)
def test_cosines_less_one_are_the_same_network_with_other_biases(
    agent_class: type[GtState] | type[GtState2Step],
) -> None:
    config = GtStateConfig(lifts=(0.05, 0.3), yaws=(2,))
    whole = agent_class(6, config, seed=0)
    less = agent_class(6, dataclasses.replace(config, cosines_less_one=True), seed=0)
    state, target = torch.rand(8, 6), torch.rand(8, 6)
    lift = torch.zeros(8, dtype=torch.int64)
    assert whole(state, target, lift).total() != less(state, target, lift).total()
    for network in less.children():
        d = len(network.turns)
        for layer in network.children():  # of its inputs the last 3 d are positions, cosines, sines
            layer.bias.data += layer.weight.data[:, -2 * d : -d].sum(dim=1)
    for one, other in zip(whole(state, target, lift), less(state, target, lift), strict=True):
        assert torch.allclose(one, other, rtol=1e-4)


def test_runs_that_do_not_say_how_they_see_cosines_see_them_whole() -> None:
    config = dataclasses.asdict(WHOLE)
    del config["cosines_less_one"]
    description = AgentDescription(
        task="block-notarget", agent="gt-mlp", config=config, state_size=3
    )
    made, whole = make_agent(description), GtState(3, WHOLE, seed=0)
    state = torch.tensor([[0.5, 0.1, -1.0 / 15]])
    assert torch.equal(made.network(state).mean, whole.network(state).mean)


def test_cosines_less_one_keep_a_step_of_training_short() -> None:
    """On the mean of a state of 300 positions cosines act together, by 300 step sizes or so."""
    moves = []
    for less_one in (False, True):
        network = GtState(300, GtStateConfig(cosines_less_one=less_one), seed=0).network
        state = torch.linspace(-0.5, 0.5, 300)[None]
        before = network(state).mean
        optimiser = KerasAdam(network.parameters(), lr=2e-4)
        before.sum().backward()
        optimiser.step()
        moves.append(float((network(state).mean - before).detach().abs().mean()))
    whole, less = moves
    assert whole > 300 * 2e-4 + less


@pytest.mark.parametrize("agent_class", AGENTS)
def test_agent_learns_an_action_that_depends_on_the_state(
    agent_class: type[GtState] | type[GtState2Step],
) -> None:
    """Pick the block, place it opposite, turned as it is; carry high where it lies far."""
    config = GtStateConfig(lifts=(0.05, 0.3), one_rotation=False, yaws=(2,))
    agent = agent_class(3, config, seed=0)
    rng = np.random.default_rng(0)

    def scenes(n: int) -> tuple[np.ndarray, np.ndarray]:
        x, y, yaw = rng.uniform([0.3, -0.4, -2], [0.7, 0.4, 2], (n, 3)).T
        lift = np.where(y > 0, 0.3, 0.05)
        action = np.column_stack([x, y, 0 * yaw, x, -y, yaw, lift])
        return np.column_stack([x, y, -yaw / 15]).astype(np.float32), action

    optimiser = KerasAdam(agent.parameters(), lr=1e-3)
    for _ in range(400):
        state, action = scenes(64)
        losses = agent(
            torch.from_numpy(state),
            torch.from_numpy(encode_action(action)),
            torch.from_numpy(action[:, 6] > 0.1).long(),
        )
        optimiser.zero_grad()
        losses.total().backward()
        optimiser.step()
    state, action = scenes(64)
    drawn = agent.act(torch.from_numpy(state), rng=np.random.default_rng(1))
    again = agent.act(torch.from_numpy(state), rng=np.random.default_rng(1))
    assert np.array_equal(drawn, again)
    assert np.median(np.abs(drawn - action)[:, [0, 1, 3, 4]]) < 0.02
    assert np.median(np.abs(drawn - action)[:, 5]) < 0.3
    assert (drawn[:, 6] == action[:, 6])[np.abs(state[:, 1]) > 0.1].mean() > 0.95
    agent.config = dataclasses.replace(config, one_rotation=True)
    assert not agent.act(torch.from_numpy(state), rng=np.random.default_rng(1))[:, [2, 5]].any()


@pytest.mark.parametrize("agent_class", AGENTS)
def test_the_lift_goes_with_the_action_that_was_drawn(
    agent_class: type[GtState] | type[GtState2Step],
) -> None:
    """In one state a bag is either pulled, low, or carried, high: the state alone does not say."""
    config = GtStateConfig(lifts=(0.05, 0.3))
    agent = agent_class(2, config, seed=0)
    rng = np.random.default_rng(0)
    state = torch.from_numpy(np.tile(np.array([0.4, 0.1], np.float32), (256, 1)))

    def actions() -> np.ndarray:
        carried = rng.random(256) < 0.3
        action = np.zeros((256, 7))
        action[:, :2], action[:, 3:5] = [0.4, 0.1], [0.3, 0.1]
        action[carried, 3:5], action[:, 6] = [0.6, -0.3], np.where(carried, 0.3, 0.05)
        return action

    optimiser = KerasAdam(agent.parameters(), lr=1e-3)
    for _ in range(300):
        action = actions()
        index = torch.from_numpy(action[:, 6] > 0.1).long()
        losses = agent(state, torch.from_numpy(encode_action(action)), index)
        optimiser.zero_grad()
        losses.total().backward()
        optimiser.step()
    drawn = agent.act(state, rng=rng)
    carried = drawn[:, 4] < -0.1
    assert 0.2 < carried.mean() < 0.4
    assert (drawn[:, 6] == np.where(carried, 0.3, 0.05)).all()


@pytest.mark.parametrize("one_rotation", [True, False])
def test_the_lift_hangs_on_yaws_only_where_they_are_carried_out(one_rotation: bool) -> None:
    config = GtStateConfig(lifts=(0.05, 0.3), one_rotation=one_rotation)
    lift = LiftMLP(2, config=config, generator=torch.Generator().manual_seed(0))
    state, action = torch.tensor([[0.4, 0.1]]), torch.tensor([[0.4, 0.1, 0.0, 0.5, 0.2, 0.0]])
    turned = action + torch.tensor([0.0, 0.0, 0.1, 0.0, 0.0, -0.1])
    assert torch.equal(lift(state, action), lift(state, turned)) is one_rotation


def test_wrong_input_is_refused() -> None:
    with pytest.raises(InputError, match=r"\(B, 7\)"):
        encode_action(np.zeros(7))
    with pytest.raises(InputError, match="lifts"):
        GtStateConfig(lifts=())
