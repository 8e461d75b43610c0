"""The Gymnasium environment: seeds, options, goals, errors, a task of one's own."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from fixtures.episode_samples import make_episode
from fixtures.places import ROOT
from gymnasium.error import ResetNeeded

from warp_deform import PickPlaceEnv
from warp_deform.episodes import EpisodeWriter, Goal
from warp_deform.errors import InputError
from warp_deform.robots.primitive import Outcome
from warp_deform.worlds.spaces import action_space, check_action
from warp_deform.xpbd.guards import Problem, ProblemKind

EXAMPLES = ROOT / "examples"
SPACE = action_space()
MIDDLE = (SPACE.low + SPACE.high) / 2
BLOCK = "block-notarget"


@pytest.fixture(scope="module")
def block() -> PickPlaceEnv:
    """The quickest task; two actions an episode."""
    return PickPlaceEnv(BLOCK)


def finish(env: PickPlaceEnv, action: np.ndarray) -> dict:
    """Act until the episode ends; its last info."""
    terminated = truncated = False
    while not (terminated or truncated):
        _, _, terminated, truncated, info = env.step(action)
    return info


def test_made_by_id_and_by_name_are_the_same() -> None:
    by_id = gymnasium.make("WarpDeform/BlockNotarget-v2")
    hashes = [env.reset(seed=7)[1]["state_hash"] for env in (by_id, PickPlaceEnv(BLOCK))]
    assert hashes[0] == hashes[1]


def test_action_space_takes_float32_of_its_own_limits() -> None:
    for corner in (SPACE.low, SPACE.high, [0.25, -0.5, -np.pi, 0.75, 0.5, np.pi, 0.04]):
        rounded = np.asarray(corner, np.float32)
        assert np.array_equal(check_action(rounded), rounded.astype(float))


@pytest.mark.parametrize(
    ("index", "value", "said"),
    [
        (0, 0.2, "pick x is 0.2 m, allowed are 0.25 to 0.75"),
        (2, 4.0, "pick yaw is 4 rad"),
        (4, -0.51, "place y is -0.51 m"),
        (6, 0.03, "lift is 0.03 m, allowed are 0.04 to 0.4"),
        (6, np.nan, "lift is nan m"),
        (3, np.inf, "place x is inf m"),
    ],
)
def test_action_out_of_the_space_is_refused_by_name(
    block: PickPlaceEnv, index: int, value: float, said: str
) -> None:
    _, before = block.reset(seed=0)
    action = MIDDLE.copy()
    action[index] = value
    with pytest.raises(InputError, match=said):
        block.step(action)
    assert block.worlds.hash(0) == before["state_hash"]


@pytest.mark.parametrize("action", [np.zeros(6), "a", None, [[0.5] * 7], [0.5] * 6 + ["x"]])
def test_what_is_no_action_is_refused(block: PickPlaceEnv, action: object) -> None:
    block.reset(seed=0)
    with pytest.raises(InputError, match="7 numbers"):
        block.step(action)


def test_no_step_before_reset_nor_after_the_end() -> None:
    env = PickPlaceEnv(BLOCK, render_mode="rgb_array")
    for call in (lambda: env.step(MIDDLE), env.render, env.demonstrate):
        with pytest.raises(ResetNeeded):
            call()
    env.reset(seed=0)
    info = finish(env, MIDDLE)
    assert info["actions"] == 2 and not info["success"] and info["outcome"] == "missed"
    with pytest.raises(ResetNeeded):
        env.step(MIDDLE)


def test_reward_is_the_change_of_score_and_success_terminates() -> None:
    env = PickPlaceEnv("cable-line-notarget")
    _, info = env.reset(seed=4)
    first, rewards = info["score"], []
    terminated = truncated = False
    while not (terminated or truncated):
        action = env.demonstrate()
        assert action is not None
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
    assert terminated and not truncated and info["is_success"] and info["score"] == 1.0
    assert first + sum(rewards) == pytest.approx(1.0)
    assert info["outcome"] == "placed" and info["stage_rule"] == "action"


def test_untrusted_physics_truncates_and_never_succeeds(
    block: PickPlaceEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    block.reset(seed=0)
    action = block.demonstrate()
    simulate = block.worlds.step

    def blow_up(actions: dict) -> dict:
        reports = simulate(actions)
        assert block.worlds.solved(0)
        episode = block.worlds.episodes[0]
        episode.problems = (Problem(ProblemKind.NONFINITE, 0, float("nan"), 0.0),)
        episode.snapshot.body_q[:] = np.nan
        return reports

    monkeypatch.setattr(block.worlds, "step", blow_up)
    seen, reward, terminated, truncated, info = block.step(action)
    assert (terminated, truncated, reward) == (False, True, 0.0)
    assert not info["success"] and not info["physics_ok"] and info["score"] == 0.0
    assert "non-finite" in info["problems"]
    assert block.observation_space.contains(seen) and not seen["color"].any()
    monkeypatch.undo()
    assert block.reset(seed=0)[1]["physics_ok"]


def test_resets_without_a_seed_follow_from_the_last_one(block: PickPlaceEnv) -> None:
    runs = []
    for _ in range(2):
        chain = [block.reset(seed=5), block.reset(), block.reset()]
        runs.append([(info["seed"], info["state_hash"]) for _, info in chain])
    assert runs[0] == runs[1] and len(set(runs[0])) == 3
    assert runs[0][0][0] == 5 and all(seed >= 1_000_000 for seed, _ in runs[0][1:])


def test_callers_may_change_what_they_get(block: PickPlaceEnv) -> None:
    seen, info = block.reset(seed=2)
    copies = {name: array.copy() for name, array in seen.items()}
    for array in (*seen.values(), info["segmentation"], info["ground_truth"]):
        array[:] = 0
    again, _ = block.reset(seed=2)
    assert all(np.array_equal(copies[name], again[name]) for name in copies)
    assert block.demonstrate() is not None


def test_a_given_goal_is_what_the_episode_is_scored_by(block: PickPlaceEnv) -> None:
    block.reset(seed=8)
    goal = block.worlds.episodes[0].goal
    seen, info = block.reset(seed=9, options={"goal": goal})
    assert np.array_equal(seen["goal_color"], goal.color) and info["seed"] == 9
    assert np.array_equal(info["ground_truth"][3:5], goal.targets[:2].astype(np.float32))
    _, _, terminated, _, _ = block.step(block.demonstrate())
    assert terminated


def test_goals_come_from_episode_files_and_folders(block: PickPlaceEnv, tmp_path: Path) -> None:
    writer, poses = EpisodeWriter(tmp_path), []
    for seed in (20, 21):
        block.reset(seed=seed)
        state = block.worlds.episodes[0].snapshot
        episode = make_episode(seed=seed)
        pictures = {"color": state.images.color, "height": state.images.height}
        arrays = {
            name: getattr(state, name)
            for name in ("particle_q", "particle_qd", "body_q", "body_qd")
        }
        steps = tuple(replace(step, **pictures, **arrays) for step in episode.steps)
        poses.append(block.task.goal_targets(block.worlds.episodes[0].layout, state))
        extra = {"goal_targets": poses[-1].tolist()}
        info = replace(episode.info, task=BLOCK, success=True, goal=None, extra=extra)
        writer.write(replace(episode, info=info, steps=steps, goal=None))
    for given, seed, pose in (
        (tmp_path, 10_000, poses[0]),
        (str(tmp_path), 10_001, poses[1]),
        (tmp_path / "episode_000000021.parquet", 10_000, poses[1]),
    ):
        _, _ = block.reset(seed=seed, options={"goal": given})
        goal = block.worlds.episodes[0].goal
        assert np.array_equal(goal.targets, pose) and goal.kind == "demonstrated"
    line = PickPlaceEnv("cable-line-notarget")
    with pytest.raises(InputError, match="holds a goal of block-notarget"):
        line.reset(seed=0, options={"goal": tmp_path})


def test_wrong_options_are_named(block: PickPlaceEnv, tmp_path: Path) -> None:
    picture = np.zeros((320, 160, 3), np.uint8)
    flat = Goal(picture, np.zeros((320, 160), np.float32), np.zeros((24, 2)), "constructed", 0)
    for options, said in (
        ({"gaol": 1}, "has no option 'gaol'"),
        ({"goal": 3}, "a Goal or a path"),
        ({"goal": tmp_path / "none"}, "no goal at"),
        ({"goal": flat}, "finite targets"),
    ):
        with pytest.raises(InputError, match=said):
            block.reset(seed=0, options=options)
    with pytest.raises(InputError, match="no goal-conditioned task"):
        PickPlaceEnv("cable-ring").reset(seed=0, options={"goal": flat})
    with pytest.raises(InputError, match="render_mode"):
        PickPlaceEnv(BLOCK, render_mode="human")
    with pytest.raises(InputError, match="did you mean 'cable-ring'"):
        PickPlaceEnv("cabel-ring")
    with pytest.raises(InputError, match="robot"):
        PickPlaceEnv(BLOCK, robot="r2d2")


def test_frames_for_people() -> None:
    env = PickPlaceEnv(BLOCK, render_mode="rgb_array", robot="panda")
    env.reset(seed=0)
    frame = env.render()
    assert frame is not None and frame.shape == (360, 640, 3) and frame.std() > 5
    env.worlds.episodes[0].snapshot.body_q[:] = np.nan
    assert not env.render().any()
    assert PickPlaceEnv(BLOCK).render() is None


def test_own_task_needs_no_registry(forgets_tasks: None) -> None:
    module = runpy.run_path(str(EXAMPLES / "own_task.py"))
    env = PickPlaceEnv(module["CableGather"]())
    _, info = env.reset(seed=1)
    assert 0 < info["score"] < 0.9 and info["ground_truth"].shape == (75,)
    action = env.demonstrate()
    assert action is not None
    *_, info = env.step(action)
    assert info["outcome"] == Outcome.PLACED.value
