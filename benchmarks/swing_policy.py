"""What a policy of a swing comes to that is trained by analytic gradients, on goals held out.

    python benchmarks/swing_policy.py [TASK] [--updates N] [--seed S] [--goals N]

Prints one line of JSON: CPU seconds of the training, and of goals from 10,000 on, which training
never saw, mean distance, shares within 10, 5, 2 and 1 cm, and the mean of exp(-10 D), `whip`'s
score. Goals at which a guard fires are counted, and count as missed; means leave them out.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
import torch

from learning.control.apg import ApgConfig, play, train_apg


def main() -> None:
    """Train, play, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("task", nargs="?", default="whip-target", choices=["whip", "whip-target"])
    parser.add_argument("--updates", type=int, default=ApgConfig.updates)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--goals", type=int, default=64)
    options = parser.parse_args()
    torch.set_num_threads(1)
    begun = time.process_time()
    config = ApgConfig(updates=options.updates)
    actor = train_apg(options.task, config, seed=options.seed, progress=True)
    spent = time.process_time() - begun
    left = play(options.task, actor, range(10_000, 10_000 + options.goals))
    fine = left[np.isfinite(left)]
    print(
        json.dumps(
            {
                "task": options.task,
                "updates": options.updates,
                "seed": options.seed,
                "goals": options.goals,
                "cpu_s": spent,
                "guards": len(left) - len(fine),
                "mean_cm": float(100 * fine.mean()) if len(fine) else None,
                **{f"within_{cm}_cm": float((left < cm / 100).mean()) for cm in (10, 5, 2, 1)},
                "score": float(np.exp(-10 * left).mean()),
            }
        )
    )


if __name__ == "__main__":
    main()
