"""From nothing to a tested policy by three commands, timed: demonstrations, training, evaluation.

    python benchmarks/policies.py --write

By default the commands of the README: cable-line-notarget from 10 demonstrations. The paper's
values, best of ten snapshots on 20 test seeds and mean of three runs, are 94.7 % (Goal-Split) and
99.7 % (Goal-Stack); ours is one run's snapshot, chosen on validation seeds, on test seeds. CPU
seconds are those of a command and all its processes; seconds are the wall's, and say something on a
machine that does nothing else. A folder that was interrupted is gone on with, and then the times
are those of the rest. `peak_gb` is the most memory that one process held.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

WRITTEN = Path(__file__).parent / "results" / "learning" / "policies.jsonl"


def commands(options: argparse.Namespace) -> dict[str, list[str]]:
    """Arguments of `warp-deform` by what they do, in their order."""
    data = options.out / "demos" / options.task
    run = options.out / "runs" / f"{options.task}-{options.agent}-{options.demos}"
    episodes = ["--episodes", str(options.episodes)] if options.episodes != 200 else []
    seed = ["--seed", str(options.seed)] if options.seed else []
    return {
        "demo": ["demo", options.task, "-n", str(options.demos), "--out", str(data)],
        "train": ["train", options.task, "--agent", options.agent, "--preset", "fast",
                  "--data", str(data), "--out", str(run), *seed],
        "eval": ["eval", str(run), *episodes],
    }  # fmt: skip


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Times [s] and results."""
    row: dict[str, Any] = {
        "task": options.task,
        "agent": options.agent,
        "demos": options.demos,
        "seed": options.seed,
        "cores": os.cpu_count(),
    }
    said: dict[str, dict[str, Any]] = {}
    for name, arguments in commands(options).items():
        began, before = time.perf_counter(), _children()
        command = [sys.executable, "-m", "warp_deform", *arguments, "--json"]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
        said[name] = json.loads(done.stdout)
        row[f"{name}_seconds"] = round(time.perf_counter() - began, 1)
        row[f"{name}_cpu_seconds"] = round(_children() - before, 1)
    for kind in ("seconds", "cpu_seconds"):
        row[f"total_{kind}"] = round(sum(row[f"{name}_{kind}"] for name in said), 1)
    row["peak_gb"] = round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20, 2)
    row["steps"] = said["train"]["steps"]
    report = said["eval"]
    row["selected"], row["revision"] = report["selected"], report["revision"]
    test = report["test"]
    keys = ("n_episodes", "n_success", "pc_success_ci95", "mean_score", "mean_actions")
    return row | {key: test[key] for key in keys}


def _children() -> float:
    """CPU time of all processes that this one waited for, theirs included [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    made.add_argument("--task", default="cable-line-notarget")
    made.add_argument("--agent", default="goal-split")
    made.add_argument("--demos", type=int, default=10)
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--episodes", type=int, default=200)
    made.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    made.add_argument("--write", action="store_true", help=f"add the row to {WRITTEN.name}")
    return made


def main() -> None:
    options = parser().parse_args()
    row = measure(options)
    print(json.dumps(row))
    if options.write:
        with WRITTEN.open("a") as file:
            file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
