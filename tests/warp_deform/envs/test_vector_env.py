"""The vector environment, and the privileged rule with and without one."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from warp_deform import PickPlaceEnv, PickPlaceVectorEnv, PrivilegedStage
from warp_deform.envs.wrappers import VectorPrivilegedStage
from warp_deform.errors import InputError
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.task import Stage
from warp_deform.worlds.spaces import action_space

SPACE = action_space()
MIDDLE = (SPACE.low + SPACE.high) / 2
BLOCK = "block-notarget"


def test_vector_episodes_are_those_of_single_environments() -> None:
    block, seeds = PickPlaceEnv(BLOCK), [31, 4, 18]
    envs = gymnasium.make_vec(
        "WarpDeform/BlockNotarget-v2", num_envs=3, vectorization_mode="vector_entry_point"
    )
    assert isinstance(envs, PickPlaceVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, infos = envs.reset(seed=seeds)
    assert envs.observation_space.contains(observations)
    vector = [list(infos["state_hash"])]
    rng = np.random.default_rng(0)
    plan = [rng.uniform(envs.action_space.low, envs.action_space.high) for _ in range(4)]
    for actions in plan:
        *_, infos = envs.step(actions)
        vector.append(list(infos["state_hash"]))
    for i, seed in enumerate(seeds):
        _, info = block.reset(seed=seed)
        chain, over = [info["state_hash"]], False
        for actions in plan:
            if over:
                _, info = block.reset()
                over = False
            else:
                _, _, terminated, truncated, info = block.step(actions[i])
                over = terminated or truncated
            chain.append(info["state_hash"])
        assert chain == [hashes[i] for hashes in vector]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_autoreset(mode: AutoresetMode) -> None:
    envs = PickPlaceVectorEnv(BLOCK, 2, autoreset_mode=mode.value)
    miss = np.tile(MIDDLE, (2, 1))
    miss[:, :2] = SPACE.low[:2]
    with pytest.raises(ResetNeeded):
        envs.step(miss)
    observations, infos = envs.reset(seed=0)
    assert infos["seed"].tolist() == [0, 1] and infos["outcome"].tolist() == ["", ""]
    # The first environment solves its task, the second runs out of actions a step later.
    episode = envs.worlds.episodes[0]
    solve = miss.copy()
    solve[0] = envs.task.demonstrate(episode.layout, episode.snapshot, np.random.default_rng(0))
    observations, rewards, terminations, truncations, infos = envs.step(solve)
    assert (terminations.tolist(), truncations.tolist()) == ([True, False], [False, False])
    assert rewards.tolist() == [1.0, 0.0]
    if mode is AutoresetMode.SAME_STEP:
        assert infos["_final_info"].tolist() == [True, False]
        assert infos["final_info"]["success"].tolist() == [True, False]
        assert envs.single_observation_space.contains(infos["final_obs"][0])
        assert infos["seed"][0] >= 1_000_000 and infos["seed"][1] == 1
        assert not np.array_equal(infos["final_obs"][0]["color"], observations["color"][0])
        return
    assert infos["success"].tolist() == [True, False] and infos["seed"].tolist() == [0, 1]
    if mode is AutoresetMode.DISABLED:
        with pytest.raises(ResetNeeded, match="environments 0 are over"):
            envs.step(miss)
        untouched = infos["state_hash"][1]
        _, infos = envs.reset(seed=[6, None], options={"reset_mask": np.array([True, False])})
        assert infos["seed"].tolist() == [6, 0] and infos["_seed"].tolist() == [True, False]
        assert envs.worlds.hash(1) == untouched
    ignored = miss.copy()
    if mode is AutoresetMode.NEXT_STEP:
        ignored[0] = np.nan
    _, rewards, terminations, truncations, infos = envs.step(ignored)
    assert truncations.tolist() == [False, True] and not terminations.any()
    if mode is AutoresetMode.NEXT_STEP:
        assert infos["outcome"].tolist() == ["", "missed"] and infos["actions"].tolist() == [0, 2]


def test_vector_errors_name_the_environment() -> None:
    envs = PickPlaceVectorEnv(BLOCK, 2)
    envs.reset(seed=0)
    actions = np.tile(MIDDLE, (2, 1))
    actions[1, 6] = 1.0
    with pytest.raises(InputError, match="environment 1: lift is 1 m"):
        envs.step(actions)
    with pytest.raises(InputError, match="shape"):
        envs.step(MIDDLE)
    for arguments, said in (
        ({"seed": [1]}, "2 environments need 2 seeds"),
        ({"options": {"goal": [None]}}, "2 environments need 2 goals"),
        ({"options": {"reset_mask": np.zeros(2, bool)}}, "reset_mask"),
        ({"options": {"mask": 0}}, "has no option"),
    ):
        with pytest.raises(InputError, match=said):
            envs.reset(**arguments)
    for wrong in ({"num_envs": 0}, {"autoreset_mode": "Never"}, {"render_mode": "human"}):
        with pytest.raises(InputError):
            PickPlaceVectorEnv(BLOCK, **wrong)


def test_vector_goals_one_for_all_or_one_each() -> None:
    envs = PickPlaceVectorEnv(BLOCK, 2, render_mode="rgb_array")
    envs.reset(seed=0)
    first = envs.worlds.episodes[0].goal
    seen, _ = envs.reset(seed=[2, 3], options={"goal": first})
    assert all(np.array_equal(picture, first.color) for picture in seen["goal_color"])
    seen, _ = envs.reset(seed=[2, 3], options={"goal": [None, first]})
    assert not np.array_equal(seen["goal_color"][0], first.color)
    assert np.array_equal(seen["goal_color"][1], first.color)
    assert [frame.shape for frame in envs.render()] == [(360, 640, 3)] * 2


class TwoStages(BlockNotarget):
    """Carries low until the block itself was picked, and high from then on."""

    stages = (Stage(0.10, 0.5), Stage(0.30, 0.5))

    def privileged_stage(self, segment, snapshot, previous):
        on_block = segment in snapshot.segments[0]
        return self.stages[1] if on_block or previous is self.stages[1] else self.stages[0]


def lifts(env: PickPlaceEnv | PickPlaceVectorEnv, monkeypatch: pytest.MonkeyPatch) -> list:
    """Lifts of every later step of the simulator."""
    seen, step = [], env.worlds.step

    def record(actions: dict) -> dict:
        seen.append([float(action[6]) for action in actions.values()])
        return step(actions)

    monkeypatch.setattr(env.worlds, "step", record)
    return seen


def test_privileged_rule_takes_the_lift_from_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    env = PrivilegedStage(PickPlaceEnv(TwoStages()))
    assert env.action_space.shape == (6,)
    _, info = env.reset(seed=3)
    assert info["stage_rule"] == "privileged"
    seen = lifts(env.unwrapped, monkeypatch)
    away, on_object = MIDDLE[:6].copy(), env.unwrapped.demonstrate()[:6]
    away[:2] = SPACE.low[:2]
    env.step(away)
    *_, info = env.step(on_object)
    env.reset(seed=3)
    env.step(on_object)
    assert seen == [[0.1], [0.3], [0.3]] and info["stage_rule"] == "privileged"
    with pytest.raises(InputError, match=r"shape \(6,\)"):
        env.step(MIDDLE)
    with pytest.raises(InputError, match="PickPlaceEnv"):
        PrivilegedStage(gymnasium.make("CartPole-v1"))


def test_privileged_rule_in_a_vector_follows_every_episode(monkeypatch) -> None:
    envs = VectorPrivilegedStage(PickPlaceVectorEnv(TwoStages(), 2, autoreset_mode="SameStep"))
    _, infos = envs.reset(seed=0)
    assert infos["stage_rule"].tolist() == ["privileged"] * 2
    seen = lifts(envs.unwrapped, monkeypatch)
    away = np.tile(MIDDLE[:6], (2, 1))
    away[:, :2] = SPACE.low[:2]
    on_block = away.copy()
    on_block[1, :2] = on_block[1, 3:5] = envs.unwrapped.worlds.episodes[1].snapshot.body_q[0, :2]
    envs.step(on_block)
    *_, infos = envs.step(away)  # sticky in the second environment; then both episodes are over
    assert infos["final_info"]["stage_rule"].tolist() == ["privileged"] * 2
    envs.step(away)
    assert seen == [[0.1, 0.3], [0.1, 0.3], [0.1, 0.1]]


def test_a_task_with_stages_needs_a_rule() -> None:
    class NoRule(BlockNotarget):
        stages = TwoStages.stages

    env = PrivilegedStage(PickPlaceEnv(NoRule()))
    env.reset(seed=0)
    with pytest.raises(TypeError, match="2 stages and no rule"):
        env.step(MIDDLE[:6])
