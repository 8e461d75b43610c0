"""What searches come to on swings of a cable, by evaluations and CPU seconds.

    python benchmarks/swings.py [--tasks TASK...] [--evaluations N...] [--out FILE]

Goals are those of 32 test seeds from 10,000. One row a task, method and number of evaluations a
goal: mean score of `whip`, and distance and shares within 10, 5, 2 and 1 cm of `whip-target`. CPU
seconds are those of the process for all goals together. Rows of other tasks and numbers stay in the
file.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from warp_deform.control import SwingProblem, optimize

GOALS = 32


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
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/swings.jsonl"))
    parser.add_argument("--tasks", nargs="+", default=["whip", "whip-target"])
    parser.add_argument("--methods", nargs="+", default=["random", "cem", "cmaes"])
    parser.add_argument("--evaluations", nargs="+", type=int, default=[250, 1000])
    options = parser.parse_args()
    rows = {}
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row = json.loads(line)
            rows[row["task"], row["method"], row["evaluations"]] = row
    for task in options.tasks:
        problem = SwingProblem(task, range(10_000, 10_000 + GOALS))
        problem.evaluate(np.zeros((GOALS, 1, *problem.shape)))  # compiles its kernels
        for method in options.methods:
            for evaluations in options.evaluations:
                found = optimize(problem, method, evaluations=evaluations)
                row = {
                    "task": task, "method": method, "evaluations": evaluations, "goals": GOALS,
                    **told(task, found.losses), "cpu_s": found.cpu_seconds,
                    "cpu_s_a_goal": found.cpu_seconds / GOALS,
                }  # fmt: skip
                rows[task, method, evaluations] = row
                print(json.dumps(row), flush=True)
                lines = [json.dumps(rows[key]) for key in sorted(rows)]
                options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
