"""What methods come to on swings of a cable, all with the same CPU seconds.

    python benchmarks/swings.py [--tasks TASK...] [--methods METHOD...] [--seconds S...]
                                [--goals N] [--out FILE]

Goals are those of 200 test seeds from 10,000. One row a task, method and budget, in CPU seconds of
the process a goal: mean score of `whip`, and distance and shares within 10, 5, 2 and 1 cm of
`whip-target`. All rows of a call come from one process, on one thread. Rows of other tasks, methods
and budgets stay in the file.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import numpy as np
import torch

from warp_deform.control import METHODS, SwingProblem, optimize


def told(task: str, losses: np.ndarray) -> dict[str, float]:
    """What the best losses (G,) of a task mean."""
    if task == "whip":
        scores = np.exp(-10 * losses)
        return {"score": float(scores.mean()), "solved": float((scores >= 0.83).mean())}
    shares = {f"within_{cm}_cm": float((losses < cm / 100).mean()) for cm in (10, 5, 2, 1)}
    return {
        "mean_cm": float(100 * losses.mean()), "median_cm": float(100 * np.median(losses)), **shares
    }  # fmt: skip


def main() -> None:
    """Measure, and print rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/swings.jsonl"))
    parser.add_argument("--tasks", nargs="+", default=["whip", "whip-target"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seconds", nargs="+", type=float, default=[0.2], help="a goal")
    parser.add_argument("--goals", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = {}
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row = json.loads(line)
            rows[row["task"], row["method"], row["seconds"]] = row
    for task in options.tasks:
        problem = SwingProblem(task, range(10_000, 10_000 + options.goals))
        nothing = np.zeros((options.goals, 1, *problem.shape))
        problem.evaluate(nothing)  # this and the next line compile kernels
        problem.gradients(nothing[:, 0], np.arange(options.goals))
        for method in options.methods:
            for seconds in options.seconds:
                found = optimize(problem, method, seconds=seconds * options.goals)
                row = {
                    "task": task, "method": method, "seconds": seconds, "goals": options.goals,
                    **told(task, found.losses), "plans": round(found.evaluations),
                    "gradients": round(found.gradients), "unusable": found.unusable,
                    "cpu_s_a_goal": found.cpu_seconds / options.goals, "load": os.getloadavg()[0],
                }  # fmt: skip
                rows[task, method, seconds] = row
                print(json.dumps(row), flush=True)
                lines = [json.dumps(rows[key]) for key in sorted(rows)]
                options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
