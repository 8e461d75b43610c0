"""Stable-Baselines3 takes the environments as they are: its own checks, and a short training."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import stable_baselines3
from stable_baselines3.common.env_checker import check_env

import warp_deform  # noqa: F401  (registers the ids)


def test_checks_and_a_short_training_pass_without_a_wrapper() -> None:
    env = gymnasium.make(
        "WarpDeform/BlockNotarget-v2",
        obs_mode="state",
        action_mode="normalized",
        reward_mode="dense",
        snap=1.0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, warn=True, skip_render_check=True)
    model = stable_baselines3.PPO(
        "MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu"
    )
    before = [p.detach().numpy().copy() for p in model.policy.parameters()]
    model.learn(32)
    moved = [
        not np.array_equal(was, p.detach().numpy())
        for was, p in zip(before, model.policy.parameters(), strict=True)
    ]
    assert model.num_timesteps == 32 and all(moved)
    episodes = model.ep_info_buffer
    assert len(episodes) == 16 and all(np.isfinite(episode["r"]) for episode in episodes)
