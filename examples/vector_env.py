"""Random actions in a vector environment: several episodes side by side, with autoreset.

python examples/vector_env.py [--env WarpDeform/CableRing-v3] [--num-envs 16] [--steps 30]
"""

from __future__ import annotations

import argparse
import time

import gymnasium
import numpy as np

import warp_deform
from warp_deform.quiet import quiet_warp


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--env", default="WarpDeform/CableRing-v3", help="a Gymnasium id")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0, help="of the first environment")
    options = parser.parse_args()

    quiet_warp()
    print(f"warp-deform {warp_deform.__version__}, {options.env}")
    envs = gymnasium.make_vec(options.env, num_envs=options.num_envs)
    observations, infos = envs.reset(seed=options.seed)
    for name, array in observations.items():
        print(f"{name:12} {array.dtype} {array.shape}")

    envs.action_space.seed(options.seed)
    returns, ended, best = np.zeros(envs.num_envs), 0, infos["score"].copy()
    begin = time.perf_counter()
    for _ in range(options.steps):
        actions = envs.action_space.sample()
        observations, rewards, terminations, truncations, infos = envs.step(actions)
        returns += rewards
        best = np.maximum(best, infos["score"])
        ended += int((terminations | truncations).sum())
    seconds = time.perf_counter() - begin
    outcomes, counts = np.unique(infos["outcome"].astype(str), return_counts=True)
    envs.close()

    actions_done = options.steps * options.num_envs
    print(f"{actions_done} actions in {seconds:.1f} s, {actions_done / seconds:.0f} a second")
    print(f"{ended} episodes ended; best score {best.max():.3f}, mean return {returns.mean():.3f}")
    print("last outcomes:", dict(zip(outcomes.tolist(), counts.tolist(), strict=True)))
    assert infos["physics_ok"].all() and np.isfinite(returns).all()


if __name__ == "__main__":
    main()
