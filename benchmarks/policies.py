"""From nothing to a tested policy: demonstrations, training with `fast` and evaluation, timed.

    python benchmarks/policies.py --agent goal-stack --json

By default cable-line-notarget from 10 demonstrations. The paper's values, best of ten snapshots on
20 test seeds and mean of three runs, are 94.7 % (Goal-Split) and 99.7 % (Goal-Stack); ours is one
run's snapshot, chosen on validation seeds, on 200 test seeds. A folder that was interrupted is gone
on with, and then the times are those of the rest. `peak_gb` is the most memory that this process
held in training: with --demos 1000 it shows that demonstrations stay on the disk.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from pathlib import Path
from typing import Any

from learning.report_run import evaluate_run
from learning.training import TrainConfig, train
from warp_deform.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Times [s] and results."""
    data = options.out / f"{options.task}-{options.demos}"
    run = options.out / f"{options.task}-{options.agent}-{options.demos}-{options.seed}"
    began = time.perf_counter()
    collect(CollectConfig(task=options.task, episodes=options.demos, out=data))
    collected = time.perf_counter()
    trained = train(
        TrainConfig(
            task=options.task, agent=options.agent, data=data, out=run, preset="fast",
            demos=options.demos, seed=options.seed, validate=options.validate,
            patience=1 if options.validate else None,
        )
    )  # fmt: skip
    evaluating = time.perf_counter()
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    report = evaluate_run(run, episodes=options.episodes)
    ended = time.perf_counter()
    return {
        "task": options.task,
        "agent": options.agent,
        "demos": options.demos,
        "seed": options.seed,
        "demo_seconds": collected - began,
        "train_seconds": evaluating - collected,
        "eval_seconds": ended - evaluating,
        "total_seconds": ended - began,
        "peak_gb": peak_gb,
        "cores": os.cpu_count(),
        "steps": trained.steps,
        "selected": report["selected"],
        **report["test"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="cable-line-notarget")
    parser.add_argument("--agent", default="goal-stack")
    parser.add_argument("--demos", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--validate", type=int, default=0,
                        help="validation episodes of every snapshot; training ends where they show "
                        "no gain, or nothing to gain")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    quiet_warp()
    row = measure(options)
    if options.json:
        print(json.dumps(row))
        return
    for key, value in row.items():
        print(f"{key:<20} {value:.4g}" if isinstance(value, float) else f"{key:<20} {value}")


if __name__ == "__main__":
    main()
