"""Ways to see, act and be paid in the pick-and-place environments, alone and side by side."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from warp_deform import PickPlaceEnv, PickPlaceVectorEnv, PrivilegedStage
from warp_deform.errors import InputError
from warp_deform.worlds.acting import snapped
from warp_deform.worlds.spaces import action_space

BLOCK = "block-notarget"
OBS_MODES = ("images", "state", "state_dict", "rgb", "rgbd", "rgb+state")
REWARD_MODES = ("score", "dense", "normalized_dense", "sparse", "none")


@pytest.fixture(scope="module")
def blocks() -> PickPlaceVectorEnv:
    """Two blocks, in which tests set what they are about."""
    return PickPlaceVectorEnv(BLOCK, 2, action_mode="normalized", autoreset_mode="SameStep")


def solving(envs: PickPlaceVectorEnv) -> np.ndarray:
    """What the scripted demonstrator does in every environment."""
    actions = envs.demonstrate()
    assert all(action is not None for action in actions)
    return np.stack(actions)


@pytest.mark.parametrize("mode", OBS_MODES)
def test_every_observation_is_in_its_space_and_new(mode: str) -> None:
    env = PickPlaceEnv(BLOCK, obs_mode=mode)
    seen, _ = env.reset(seed=3)
    assert env.observation_space.contains(seen)
    if mode == "state":
        assert seen.shape == (4 + 7 + 3 + 1,) and seen.dtype == np.float32
        assert np.array_equal(seen[4:11], env.worlds.episodes[0].snapshot.body_q[0])
        seen[:] = 9.0
        assert not (env.reset(seed=3)[0] == 9.0).any()
    if mode == "rgb+state":
        assert set(seen["pixels"]) == {"top", "goal"} and seen["pixels"]["top"].std() > 0
        assert seen["environment_state"].shape == (15,) and seen["agent_pos"].shape == (4,)
    env.worlds.episodes[0].snapshot.body_q[:] = np.nan
    assert env.observation_space.contains(env.observing.of(0)), "also of what cannot be trusted"


def test_normalised_actions_are_the_metric_ones_to_the_bit_of_their_rounding(blocks) -> None:
    metric = PickPlaceVectorEnv(BLOCK, 2, autoreset_mode="SameStep")
    for envs in (blocks, metric):
        envs.reset(seed=5)
    assert blocks.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
    said, meant = solving(blocks), solving(metric)
    assert np.abs(said).max() <= 1
    sent = [blocks.acting.of(action) for action in said]
    assert np.allclose(sent, meant, atol=1e-6)
    *_, infos = blocks.step(said)
    *_, in_metres = metric.step(np.stack(sent))
    ends = infos["final_info"]["state_hash"], in_metres["final_info"]["state_hash"]
    assert list(ends[0]) == list(ends[1])
    low, high = action_space().low, action_space().high
    assert np.array_equal(blocks.acting.of(-np.ones(7)), low)
    assert np.array_equal(blocks.acting.of(np.ones(7, np.float32)), high)
    for wrong in (np.full(7, 1.01), np.full(7, np.nan), np.zeros(6)):
        with pytest.raises(InputError, match=r"-1 to 1|7 numbers"):
            blocks.acting.of(wrong)
    with pytest.raises(InputError, match="in metres"):
        PrivilegedStage(PickPlaceEnv(BLOCK, action_mode="normalized"))


@pytest.mark.parametrize("name", ["cable-line-notarget", BLOCK])
def test_a_pick_is_drawn_to_the_nearest_thing_within_the_distance(name: str) -> None:
    env = PickPlaceEnv(name, snap=0.05)
    env.reset(seed=2)
    snapshot = env.worlds.episodes[0].snapshot
    things = snapshot.particle_q if len(snapshot.particle_q) else snapshot.body_q[:, :3]
    away = things[np.argmax(things[:, 0]), :2].astype(float)
    action = np.array([away[0] + 0.04, away[1], 0.0, 0.5, 0.0, 0.0, 0.1])
    drawn = snapped(action, env.task, snapshot, 0.05)
    moved = np.linalg.norm(drawn[:2] - action[:2])
    assert 0 < moved <= 0.05 and np.array_equal(drawn[2:], action[2:])
    assert np.array_equal(snapped(action, env.task, snapshot, 0.9 * moved), action), "too far"
    assert np.array_equal(snapped(drawn, env.task, snapshot, 0.05), drawn), "it takes something"
    if len(snapshot.particle_q):
        nearest = np.linalg.norm(snapshot.particle_q[:, :2] - action[:2], axis=1).min()
        assert moved == pytest.approx(nearest)
    *_, info = env.step(action)
    assert info["outcome"] == "placed" and info["pick_shift"] == pytest.approx(moved)
    plain = PickPlaceEnv(name)
    plain.reset(seed=2)
    *_, info = plain.step(action)
    assert info["outcome"] == "missed" and "pick_shift" not in info


@pytest.mark.parametrize("mode", REWARD_MODES)
def test_rewards(mode: str) -> None:
    env = PickPlaceEnv("cable-line-notarget", reward_mode=mode)
    _, info = env.reset(seed=4)
    first = info["score"]
    start = env.rewards._remaining([0])[0]
    rewards, over = [], False
    while not over:
        _, reward, terminated, truncated, info = env.step(env.demonstrate())
        assert type(reward) is float
        rewards.append(reward)
        over = terminated or truncated
    left = env.rewards._remaining([0])[0]
    assert terminated and start > left > 0
    if mode == "score":
        assert first + sum(rewards) == pytest.approx(1.0)
    elif mode == "dense":
        assert sum(rewards) == pytest.approx((start - left) / start) and sum(rewards) > 0.8
    elif mode == "normalized_dense":
        assert rewards[-1] == pytest.approx(np.exp(-left / start))
        assert 0 < min(rewards) and 0.8 < rewards[-1] <= 1
    elif mode == "sparse":
        assert rewards[-1] == 1.0 and not any(rewards[:-1])
    else:
        assert not any(rewards)


@pytest.mark.parametrize("mode", REWARD_MODES)
def test_an_untrusted_state_pays_nothing_and_counts_as_no_progress(blocks, mode: str) -> None:
    from warp_deform.worlds.rewards import Rewards
    from warp_deform.xpbd.guards import Problem, ProblemKind

    blocks.reset(seed=7)
    rewards = Rewards(blocks.worlds, mode)
    rewards.start([0, 1])
    broken = blocks.worlds.episodes[1]
    broken.problems = (Problem(ProblemKind.NONFINITE, 1, float("nan"), 0.0),)
    broken.snapshot.body_q[:] = np.nan
    paid = rewards.take([0, 1])
    assert paid[1] == 0.0 and np.isfinite(paid).all()


def test_tensors_in_and_out_are_the_same_numbers(blocks) -> None:
    torches = PickPlaceVectorEnv(
        BLOCK, 2, action_mode="normalized", autoreset_mode="SameStep", backend="torch"
    )
    torches.reset(seed=11)
    blocks.reset(seed=11)
    actions = solving(blocks)
    seen, rewards, *ends, _ = torches.step(torch.tensor(actions))
    plain, paid, *over, _ = blocks.step(actions)
    assert all(isinstance(part, torch.Tensor) for part in (*seen.values(), rewards, *ends))
    assert all(np.array_equal(seen[name].numpy(), plain[name]) for name in plain)
    assert np.array_equal(rewards.numpy(), paid) and ends[0].dtype == torch.bool
    assert [e.tolist() for e in ends] == [o.tolist() for o in over] and ends[0].all()


def test_others_ask_for_attributes_by_name(blocks) -> None:
    blocks.reset(seed=[0, 1], options={"lerobot_new_rollout": True})
    assert blocks.call("_max_episode_steps") == (2, 2)
    assert (
        blocks.call("task_description")
        == ("Move the block to where the goal picture shows it.",) * 2
    )
    assert blocks.get_attr("num_envs") == (2, 2) and blocks.unwrapped.metadata["render_fps"] == 2
    blocks.set_attr("render_mode", ["rgb_array", "rgb_array"])
    frames = blocks.call("render")
    assert len(frames) == 2 and not np.array_equal(*frames)
    blocks.set_attr("render_mode", None)
    assert blocks.call("render") == (None, None)
    with pytest.raises(AttributeError):
        blocks.call("tusk")
    for name, values in (("tusk", 1), ("render_mode", [None, "rgb_array"])):
        with pytest.raises(InputError):
            blocks.set_attr(name, values)
    one = PickPlaceEnv(BLOCK)
    one.reset(seed=0, options={"lerobot_new_rollout": True})
    assert one.get_wrapper_attr("_max_episode_steps") == 2
    assert one.get_wrapper_attr("task_description") == blocks.task_description


@pytest.mark.parametrize(
    "wrong",
    [
        {"obs_mode": "smell"}, {"action_mode": "percent"}, {"reward_mode": "money"},
        {"snap": -0.1}, {"snap": np.nan}, {"snap": "far"}, {"snap": True},
    ],
)  # fmt: skip
def test_modes_that_do_not_exist_are_named(wrong: dict) -> None:
    (name,) = wrong
    for make in (PickPlaceEnv, PickPlaceVectorEnv):
        with pytest.raises(InputError, match=name):
            make(BLOCK, **wrong)


def test_what_a_task_cannot_do_is_said() -> None:
    with pytest.raises(InputError, match="backend"):
        PickPlaceVectorEnv(BLOCK, backend="jax")
    with pytest.raises(InputError, match="has no loss"):
        PickPlaceEnv("cable-mask-goal", reward_mode="dense")
    with pytest.raises(InputError, match="jaw"):
        PickPlaceEnv("cable-mask-goal", snap=0.01)
