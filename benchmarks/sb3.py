"""Stable-Baselines3 on environments of control, as a newcomer runs it: its checker, then its PPO.

    python benchmarks/sb3.py [--env ID] [--steps N] > benchmarks/results/sb3.txt

Nothing is wrapped and nothing tuned. The policy plays 50 goals of test seeds, from 10,000, before
and after; the library's own log stands in between.
"""

from __future__ import annotations

import argparse
import warnings

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

import warp_deform  # noqa: F401  (registers the ids)
from warp_deform.quiet import quiet_warp

GOALS = range(10_000, 10_050)


def scores(model: PPO, env: gymnasium.Env) -> list[float]:
    """Scores at the end of the test goals."""
    ends = []
    for seed in GOALS:
        observation, info = env.reset(seed=seed)
        over = False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        ends.append(info["score"])
    return ends


def main() -> None:
    """Check, play, train, and play again."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--env", default="WarpDeform/WhipTarget-v1")
    parser.add_argument("--steps", type=int, default=40_960)
    options = parser.parse_args()
    quiet_warp()
    env = gymnasium.make(options.env)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env.unwrapped, warn=True, skip_render_check=True)
    print(f"check_env({options.env!r}): {len(said)} warnings", *[str(w.message) for w in said])
    model = PPO("MlpPolicy", env, verbose=1, seed=0, device="cpu")
    print(f"mean score before: {np.mean(scores(model, env)):.3f}")
    model.learn(options.steps, log_interval=5)
    print(f"mean score after {model.num_timesteps} steps: {np.mean(scores(model, env)):.3f}")


if __name__ == "__main__":
    main()
