"""Control at 20 Hz: taking, carrying, letting go, rewards, ends; alone and side by side."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from stable_baselines3.common.env_checker import check_env

from warp_deform import ControlEnv, ControlVectorEnv, PickPlaceEnv
from warp_deform.control.control_worlds import ControlWorlds
from warp_deform.control.modes import CONTROL_MODES, ControlConfig
from warp_deform.errors import InputError
from warp_deform.support.quaternion import quat_yaw
from warp_deform.tasks.registration import control_id
from warp_deform.tasks.registry import TASKS
from warp_deform.xpbd.guards import Problem, ProblemKind

BLOCK = "block-notarget"


@pytest.fixture(scope="module")
def block() -> ControlEnv:
    """The quickest task, the block in the tip from the start."""
    return ControlEnv(BLOCK, control_mode="tip_delta_pose", start="held")


def idle(env: ControlEnv, hold: float = 1.0) -> np.ndarray:
    action = np.zeros(env.action_space.shape[0])
    action[-1] = hold
    return action


def towards(env: ControlEnv, goal: np.ndarray, hold: float = 1.0) -> np.ndarray:
    """The action (5,) that leads the tip to `goal` x, y, z, yaw, as far as a step allows."""
    way = goal - env.control.targets.asked[0]
    action = np.append(way / [0.05, 0.05, 0.05, 0.1], hold)
    return np.clip(action / max(1.0, float(np.linalg.norm(action[:3]))), -1, 1)


def tip_at_goal(env: ControlEnv, height: float) -> np.ndarray:
    """Where the tip is when the block that it holds is at its target."""
    episode = env.worlds.episodes[0]
    pose, target = episode.snapshot.body_q[0].astype(float), episode.layout.targets
    yaw, offset = float(quat_yaw(pose[3:])), episode.tip[:2] - pose[:2]
    turn = target[2] - yaw
    c, s = np.cos(turn), np.sin(turn)
    xy = target[:2] + np.array([[c, -s], [s, c]]) @ offset
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.array([*xy, height, episode.tip[3] + turn])


def test_a_block_is_carried_to_its_goal_and_the_episode_ends_after_five_solved_steps(block) -> None:
    _, info = block.reset(seed=3)
    assert info["holding"] and not info["is_success"]
    low = float(block.worlds.episodes[0].tip[2])
    goal, solved = tip_at_goal(block, low), []
    for _ in range(150):
        above = block.worlds.episodes[0].tip
        far = np.abs(above - goal)[[0, 1, 3]].max() > 0.02
        wanted = goal + np.array([0, 0, 0.04 if far else 0.0, 0])
        _, reward, terminated, truncated, info = block.step(towards(block, wanted))
        assert np.isfinite(reward) and info["is_success"] == info["success"]
        solved.append(info["is_success"])
        if terminated:
            break
    assert terminated and not truncated and info["physics_ok"]
    assert solved[-5:] == [True] * 5 and not solved[-6]
    with pytest.raises(ResetNeeded):
        block.step(idle(block))


def test_a_free_tip_takes_what_is_under_it_keeps_it_and_lets_it_go() -> None:
    env = ControlEnv(BLOCK, reward_mode="none")
    env.reset(seed=3)
    spot = env.worlds.episodes[0].snapshot.body_q[0, :3].astype(float)
    assert not env.step(idle(env))[4]["holding"], "there is nothing under the waiting tip"
    top = spot[2] + 0.02
    for _ in range(30):
        way = np.array([*spot[:2], top]) - env.worlds.episodes[0].tip[:3]
        action = np.append(np.clip(way / 0.05, -1, 1), -1.0)
        *_, info = env.step(action)
    assert not info["holding"] and np.linalg.norm(way) < 0.01
    *_, info = env.step(idle(env))
    assert info["holding"]
    for _ in range(4):
        env.step(np.array([0.0, 0, 1, 1]))
    up = env.worlds.episodes[0].snapshot.body_q[0, 2]
    assert up > spot[2] + 0.1
    *_, info = env.step(idle(env, hold=0.0))
    assert not info["holding"] and env.worlds.episodes[0].snapshot.body_q[0, 2] < up
    past = env.worlds.episodes[0].history
    assert (
        len(past) == 1 and past[0].held == 0 and past[0].lift == pytest.approx(top + 0.2, abs=0.02)
    )


@pytest.mark.parametrize("release", ["rest", "moving"])
def test_what_is_let_go_moving_keeps_the_tips_velocity(release: str) -> None:
    env = ControlEnv(BLOCK, start="held", release=release)
    env.reset(seed=3)
    for _ in range(3):
        env.step(np.array([0, 0, 1.0, 1]))
    for _ in range(4):
        env.step(np.array([0, -0.6, 0, 1.0]))
    env.step(np.array([0, -0.6, 0, -1.0]))
    speed = env.worlds.episodes[0].snapshot.body_qd[0, 1]
    assert speed == pytest.approx(-0.6 if release == "moving" else 0.0, abs=0.05)


def test_no_random_action_makes_a_guard_fire_whatever_the_mode() -> None:
    for mode, names in CONTROL_MODES.items():
        worlds = ControlWorlds("whip", 8, control_mode=mode, lanes=8)
        worlds.reset({slot: slot for slot in range(8)})
        rng = np.random.default_rng(0)
        for _ in range(20):
            rows = rng.uniform(-1, 1, (8, len(names)))
            rows[:4, 2] = -1.0  # into the table all the time
            rows[:, -1] = 1.0
            worlds.step(dict(enumerate(rows)))
        assert all(worlds.worlds.episodes[slot].physics_ok for slot in range(8))
        tips = np.array([worlds.worlds.episodes[slot].tip for slot in range(8)])
        assert (tips[:, 2] >= 0.005 - 1e-9).all()


def test_a_cable_that_is_flung_about_is_no_fault_and_its_start_is_that_of_picks_and_places() -> (
    None
):
    worlds = ControlWorlds("cable-ring", 8, start="held", lanes=8)
    worlds.reset({slot: slot for slot in range(8)})
    plain = PickPlaceEnv("cable-ring")
    worlds.reset({3: 11})
    plain.reset(seed=11)
    before = plain.worlds.episodes[0].snapshot.particle_q
    free = ControlWorlds("cable-ring", 8, lanes=8)
    free.reset({2: 11})
    assert np.array_equal(free.worlds.episodes[2].snapshot.particle_q, before)
    rng = np.random.default_rng(0)
    for step in range(40):
        if step % 4 == 0:
            rows = rng.uniform(-1, 1, (8, 4))
            rows[:, -1] = 1.0
        worlds.step(dict(enumerate(rows)))
    assert all(worlds.worlds.episodes[slot].physics_ok for slot in range(8))


def test_an_episode_in_a_vector_is_that_of_a_single_environment_to_the_bit() -> None:
    envs = ControlVectorEnv("whip", 3, autoreset_mode="SameStep")
    alone = ControlEnv("whip")
    _, infos = envs.reset(seed=[5, 6, 7])
    seen, info = alone.reset(seed=6)
    assert infos["state_hash"][1] == info["state_hash"]
    rng = np.random.default_rng(1)
    for step in range(20):
        actions = rng.uniform(-1, 1, (3, 4))
        together, rewards, *ends, infos = envs.step(actions)
        seen, reward, terminated, truncated, info = alone.step(actions[1])
        assert rewards[1] == reward and [bool(e[1]) for e in ends] == [terminated, truncated]
        if step < 19:
            assert infos["state_hash"][1] == info["state_hash"]
            assert np.array_equal(together[1], seen)
    assert truncated and not terminated and ends[1].all()
    last = infos["final_info"]["state_hash"][1], envs.single_observation_space
    assert last[0] == info["state_hash"] and last[1].contains(infos["final_obs"][1])
    assert np.array_equal(infos["final_obs"][1], seen)
    assert infos["steps"].tolist() == [0, 0, 0] and (infos["seed"] >= 1_000_000).all()
    assert envs.call("_max_episode_steps") == (20, 20, 20) and envs.metadata["render_fps"] == 20


def test_dense_rewards_sum_to_the_progress_less_what_restless_actions_cost() -> None:
    rng = np.random.default_rng(2)
    plans = rng.uniform(-1, 1, (20, 4))
    sums = []
    for penalty in (0.0, 0.01):
        worlds = ControlWorlds("whip-target", 1, action_penalty=penalty)
        worlds.reset({0: 4})
        episode = worlds.worlds.episodes[0]
        start = worlds.task.distance(episode.layout, episode.snapshot)
        sums.append(sum(worlds.step({0: action})[0].reward for action in plans))
        left = worlds.task.distance(episode.layout, worlds.worlds.episodes[0].snapshot)
    assert sums[0] == pytest.approx((start - left) / start, abs=1e-4)
    changes = (np.diff(plans, axis=0) ** 2).sum()
    assert sums[0] - sums[1] == pytest.approx(0.01 * changes)


def test_a_guard_that_fires_ends_the_episode_without_a_reward(block, monkeypatch) -> None:
    block.reset(seed=0)
    fired = {0: (Problem(ProblemKind.STRETCH, 0, 2.0, 1.5),)}
    loop = block.control.tips.loop
    advance = loop.advance
    monkeypatch.setattr(loop, "advance", lambda *a, **k: advance(*a, **k) or fired)
    _, reward, terminated, truncated, info = block.step(towards(block, tip_at_goal(block, 0.1)))
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert not info["physics_ok"] and not info["is_success"] and "stretch" in info["problems"]
    monkeypatch.undo()
    assert block.reset(seed=0)[1]["physics_ok"]


def test_time_is_up_after_the_horizon_and_a_step_before_reset_is_refused() -> None:
    env = ControlEnv(BLOCK, horizon=3, start="held", obs_mode="state_dict")
    for call in (env.step, lambda action: env.reset(options={"gaol": 1})):
        with pytest.raises((ResetNeeded, InputError)):
            call(np.zeros(4))
    seen, _ = env.reset(seed=1, options={"lerobot_new_rollout": True})
    assert set(seen) == {"tip", "holding", "body_q", "goal", "time"} and seen["holding"] == 1
    ends = [env.step(idle(env))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    assert env.get_wrapper_attr("_max_episode_steps") == 3


@pytest.mark.parametrize("mode", ["state", "state_dict", "images", "rgb", "rgbd", "rgb+state"])
def test_every_observation_is_in_its_space(block, mode: str) -> None:
    from warp_deform.envs.control_env import ControlNumbers
    from warp_deform.worlds.observing import Observing

    block.reset(seed=2)
    seen = Observing(block.worlds, mode, ControlNumbers(block.control))
    assert seen.space.contains(seen.of(0))
    if mode == "rgb":
        assert seen.of(0)["agent_pos"].tolist()[4] == 1.0 and set(seen.of(0)) == {
            "pixels",
            "agent_pos",
        }


def test_stable_baselines_takes_it_as_it_is() -> None:
    env = gymnasium.make("WarpDeform/Whip-v1").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, warn=True, skip_render_check=True)
    assert (
        "softplus" in env.action_space.description
        and "hold above 0" in env.action_space.description
    )
    assert env.action_space.names == ("dx", "dy", "dz", "hold")


def test_every_task_that_a_tip_plays_has_an_id() -> None:
    for name in TASKS:
        assert control_id(name) in gymnasium.registry
    assert "WarpDeform/WhipTarget-v1" in gymnasium.registry
    assert control_id("cable-mask-goal") not in gymnasium.registry
    with pytest.raises(InputError, match="jaw"):
        ControlEnv("cable-mask-goal")


@pytest.mark.parametrize(
    "wrong",
    [
        {"control_mode": "pd_joint_pos"}, {"obs_mode": "smell"}, {"reward_mode": "money"},
        {"start": "flying"}, {"release": "softly"}, {"horizon": 0}, {"horizon": 2.5},
        {"control": ControlConfig(rate=7.0)},
    ],
)  # fmt: skip
def test_what_does_not_exist_is_named(wrong: dict) -> None:
    (name,) = wrong
    said = "rate" if name == "control" else name
    with pytest.raises(InputError, match=said):
        ControlEnv(BLOCK, **wrong)


def test_actions_that_are_none_are_refused_and_nothing_has_moved(block) -> None:
    _, info = block.reset(seed=0)
    for action in (np.zeros(4), np.full(5, 1.1), np.full(5, np.nan), "up"):
        with pytest.raises(InputError):
            block.step(action)
    assert block.worlds.hash(0) == info["state_hash"]
