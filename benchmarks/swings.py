"""What searches come to on swings of a cable, by evaluations and CPU seconds.

    python benchmarks/swings.py [--out FILE] [--goals 32]

Goals are those of the test seeds from 10,000. One row a task, method and number of evaluations a
goal: mean score of `whip`, and distance and shares within 10, 5, 2 and 1 cm of `whip-target`. CPU
seconds are those of the process for all goals together.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from warp_deform.control import SwingProblem, optimize

EVALUATIONS = (250, 1000)
METHODS = ("random", "cem", "cmaes")


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
    parser.add_argument("--goals", type=int, default=32)
    options = parser.parse_args()
    lines = []
    for task in ("whip", "whip-target"):
        problem = SwingProblem(task, range(10_000, 10_000 + options.goals))
        problem.evaluate(np.zeros((options.goals, 1, *problem.shape)))  # compiles its kernels
        for method in METHODS:
            for evaluations in EVALUATIONS:
                found = optimize(problem, method, evaluations=evaluations)
                row = {
                    "task": task, "method": method, "evaluations": evaluations,
                    "goals": options.goals, **told(task, found.losses),
                    "cpu_s": found.cpu_seconds, "cpu_s_a_goal": found.cpu_seconds / options.goals,
                }  # fmt: skip
                lines.append(json.dumps(row))
                print(lines[-1], flush=True)
    options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
