"""Episodes of control as tensors: the environment's numbers, and derivatives through a graph."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded

from warp_deform import ControlVectorEnv
from warp_deform.control import ControlWorlds, TensorControlWorlds
from warp_deform.envs.control_env import ControlNumbers
from warp_deform.errors import InputError
from warp_deform.worlds.observing import Observing

WORLDS = 8
SEEDS = dict(enumerate(range(4, 4 + WORLDS)))


def moves(seed: int, steps: int, count: int = WORLDS) -> torch.Tensor:
    """Actions (T, W, 4) at random, rather upwards, that keep hold."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform([-1, -1, -0.5, 1], 1, (steps, count, 4))
    return torch.from_numpy(actions)


@pytest.fixture(scope="module")
def worlds() -> TensorControlWorlds:
    return TensorControlWorlds("whip-target", WORLDS)


@pytest.mark.parametrize(
    ("task", "start"), [("whip-target", "free"), ("cable-line-notarget", "held")]
)
def test_everything_has_the_bits_of_the_environment(task: str, start: str) -> None:
    plain = ControlWorlds(task, WORLDS, start=start, horizon=4)
    tensors = TensorControlWorlds(task, WORLDS, start=start, horizon=4)
    seeing = Observing(plain.worlds, "state", ControlNumbers(plain))
    for seeds in (SEEDS, dict(enumerate(range(8, 8 + WORLDS)))):  # the second has kept starts
        plain.reset(seeds)
        tensors.reset(seeds)
        for actions in moves(1, 4):
            seen = np.stack([seeing.of(slot) for slot in SEEDS])
            assert np.array_equal(tensors.observe().numpy(), seen)
            step, done = tensors.advance(actions), plain.step(dict(enumerate(actions.numpy())))
            rewards = [done[slot].reward for slot in SEEDS]
            assert step.rewards.numpy() == pytest.approx(rewards, rel=1e-12, abs=1e-15)
            assert step.truncated.tolist() == [done[slot].truncated for slot in SEEDS]
            assert step.success.tolist() == [done[slot].success for slot in SEEDS]
            assert not step.terminated.any()
        assert step.truncated.all()
        hashes = [[each.worlds.hash(s) for s in SEEDS] for each in (plain, tensors)]
        assert hashes[0] == hashes[1]


def test_who_does_not_ask_what_is_solved_gets_the_same_rewards(
    worlds: TensorControlWorlds, monkeypatch: pytest.MonkeyPatch
) -> None:
    worlds.reset(SEEDS)
    actions = moves(3, 2)
    with torch.no_grad():
        rewards = [worlds.advance(row).rewards for row in actions]
        monkeypatch.setattr(worlds, "judged", False)
        monkeypatch.setattr(worlds.worlds, "solved", lambda slot: pytest.fail("it is asked"))
        worlds.reset(SEEDS)
        steps = [worlds.advance(row) for row in actions]
    assert all(torch.equal(step.rewards, a) for step, a in zip(steps, rewards, strict=True))
    assert not any(step.success.any() for step in steps)
    with pytest.raises(InputError, match="it has to be judged"):
        TensorControlWorlds("cable-line-notarget", 8, start="held", judged=False)


def test_rewards_lead_back_to_actions_as_differences_do(worlds: TensorControlWorlds) -> None:
    def total(actions: torch.Tensor) -> torch.Tensor:
        worlds.reset(SEEDS)
        rewards = [worlds.advance(each).rewards for each in actions]
        return torch.stack(rewards).sum(dim=0)

    actions = moves(2, 3)
    actions[..., 2] = 0.5
    actions.requires_grad_()
    returned = total(actions)
    (slopes,) = torch.autograd.grad(returned.sum(), actions)
    assert torch.isfinite(slopes).all() and (slopes[:, :, :3].norm(dim=-1) > 0).all()
    slopes[..., 3] = 0.0
    way = slopes / slopes.norm(dim=(0, 2), keepdim=True)
    with torch.no_grad():
        ends = [total(actions + h * way) for h in (3e-3, -3e-3)]
    found = (slopes * way).sum(dim=(0, 2))
    assert found.numpy() == pytest.approx(((ends[0] - ends[1]) / 6e-3).numpy(), rel=0.05)


def test_detach_cuts_the_graph_and_frees_it(worlds: TensorControlWorlds) -> None:
    worlds.reset(SEEDS)
    actions = moves(3, 3).requires_grad_()
    worlds.advance(actions[0])
    worlds.advance(actions[1])
    worlds.detach()
    assert not worlds.observe().requires_grad
    (slopes,) = torch.autograd.grad(worlds.advance(actions[2]).rewards.sum(), actions)
    assert not slopes[:2].any() and slopes[2].any()
    worlds.detach()
    with torch.no_grad():
        worlds.advance(actions[2])
    assert not worlds.observe().requires_grad


def test_a_world_begins_again_while_others_go_on(worlds: TensorControlWorlds) -> None:
    worlds.reset(SEEDS)
    actions = moves(4, 3).requires_grad_()
    first = worlds.advance(actions[0]).rewards
    worlds.reset({2: 20})
    second = worlds.advance(actions[1]).rewards
    (slopes,) = torch.autograd.grad((first + second).sum(), actions)
    assert slopes[0].any(dim=1).all() and slopes[1].any(dim=1).all()
    alone = TensorControlWorlds("whip-target", WORLDS)
    alone.reset(dict(enumerate(range(18, 18 + WORLDS))))
    with torch.no_grad():
        alone.advance(actions[1])
    assert alone.worlds.hash(2) == worlds.worlds.hash(2)
    assert worlds.steps.tolist() == [2, 2, 1, 2, 2, 2, 2, 2]


def test_the_vector_environment_has_a_graph_and_resets_by_itself() -> None:
    options = {"backend": "torch", "differentiable": True, "horizon": 2}
    envs = ControlVectorEnv("whip-target", WORLDS, **options)
    plain = ControlVectorEnv("whip-target", WORLDS, backend="torch", horizon=2)
    with pytest.raises(ResetNeeded):
        envs.step(moves(5, 1)[0])
    seen, _ = envs.reset(seed=4)
    assert torch.equal(seen, plain.reset(seed=4)[0])
    actions = moves(5, 4).float()
    for k, each in enumerate(actions):
        given = each.clone().requires_grad_()
        found, expected = envs.step(given), plain.step(each)
        assert torch.equal(found[0].detach(), expected[0])
        assert found[1].detach().numpy() == pytest.approx(expected[1].numpy(), rel=1e-6)
        assert torch.equal(found[2], expected[2]) and torch.equal(found[3], expected[3])
        assert np.array_equal(found[4]["is_success"], expected[4]["is_success"])
        assert found[0].requires_grad == (k != 2), "a reset leads back to no action"
        assert found[3].all() == (k == 1)
    envs.detach()
    with pytest.raises(InputError, match="action of environment 0"):
        envs.step(2 * actions[0])


@pytest.mark.parametrize(
    ("task", "options", "said"),
    [
        ("whip", {"obs_mode": "rgb"}, "obs_mode"),
        ("whip", {"backend": "numpy"}, "backend"),
        ("whip", {"reward_mode": "sparse"}, "reward_mode sparse has no derivative"),
        ("whip", {"control_mode": "tip_velocity"}, "not tip_velocity"),
        ("cable-line-notarget", {}, 'choose start="held"'),
    ],
)
def test_what_has_no_derivative_is_refused(task: str, options: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        ControlVectorEnv(task, 8, **{"backend": "torch", "differentiable": True, **options})
    with pytest.raises(InputError, match="differentiable=True"):
        ControlVectorEnv("whip", 8).detach()
