"""Ports of published control tasks: what doing nothing, chance, a script and searches come to.

    python benchmarks/ports.py [--tasks TASK...] [--methods METHOD...] [--goals N] [--seconds S]

Goals are those of test seeds from 10,000; scores, totals and losses are means over them. "idle"
does nothing, "chance" draws actions evenly, one plan a goal, "script" is one plan for all goals,
where a task has one. "random", "cem" and "cmaes" are `optimize` over plans of `EpisodeProblem`,
with S CPU seconds a goal. "adam" and "lbfgs", from the best of 50 draws, and "cem+adam" descend by
the gradients of `HeldProblem`, where a task holds one thing; "bundled" is adam by the mean of 8. A
total is the sum of the scores of all steps, DLO-Lab's return; a score is that of the end; away is
the task's loss at the end. `solved` and `guards` count goals. What has a row of as many goals and
seconds is left out, so the command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.control import EpisodeProblem, HeldProblem, optimize
from warp_deform.control.episode_problem import PlayedPlans
from warp_deform.control.plan_players import Player
from warp_deform.control.unknot import UNTIE
from warp_deform.control.wire import THROUGH
from warp_deform.support.revision import running_revision

TASKS = (
    "push-cable", "fold-fabric-1", "fold-fabric-3", "unfold-fabric-1", "unfold-fabric-3",
    "gather", "wire", "unknot",
)  # fmt: skip
DESCENTS = ("adam", "bundled", "lbfgs", "cem+adam")
BUNDLE = 8
"""Gradients in the mean of "bundled"."""
HELD = ("push-cable", "gather", "wire", "unknot")
"""Where they are possible."""
SEARCHES = ("random", "cem", "cmaes", *DESCENTS)
METHODS = ("idle", "chance", "script", *SEARCHES)
SCRIPTS = {
    "fold-fabric-1": np.array([[-1, -1, 1, 1]]),
    "fold-fabric-3": np.array([[0.0, -1.0, 0.0]]),
    "unfold-fabric-1": np.array([[0.0, -1.0, 0.0]]),
    "unfold-fabric-3": np.array([[0.0, -1.0, 0.0]]),
    "wire": THROUGH,
    "unknot": UNTIE,
}
"""A pick and place that folds, see `FoldPlayer`, every corner to its place, see `CornerPlayer`, a
path, see `PathPlayer`, and a motion, see `SmoothPlayer`."""


class Chance:
    """Actions from -1 to 1, drawn evenly by the seed that is a plan's one number."""

    shape = (1, 1)

    def begin(self, numbers: np.ndarray, layouts: object) -> None:
        """See `Player`."""
        self._rngs = [np.random.default_rng(int(plan[0, 0])) for plan in numbers]

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """See `Player`."""
        return np.stack([rng.uniform(-1, 1, 4) for rng in self._rngs])


class Idle(Chance):
    """Nothing but holding on."""

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """See `Player`."""
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(tips), 1))


def told(played: PlayedPlans) -> dict[str, float]:
    """Means over the goals, and counts of goals."""
    usable = np.isfinite(played.losses)
    return {
        "score": float(played.scores.mean()),
        "total": float(played.returns.mean()),
        "away": float(played.losses[usable].mean()) if usable.any() else -1.0,
        "solved": int(played.solved.sum()),
        "guards": int((~usable).sum()),
    }


def played_by(
    problem: EpisodeProblem, task: str, method: str, seconds: float
) -> tuple[PlayedPlans, dict[str, float]]:
    """What a method's plans come to, and what it took: evaluations and CPU seconds a goal."""
    goals, usual = range(problem.goals), problem.player
    if method in SEARCHES:
        if isinstance(problem, HeldProblem):
            problem.bundle = BUNDLE if method == "bundled" else 1
        named = "adam" if method == "bundled" else method
        found = optimize(problem, named, seconds=seconds * problem.goals)
        took = {
            "evaluations": found.evaluations,
            "cpu_s_a_goal": found.cpu_seconds / problem.goals,
        }
        return problem.play(goals, found.numbers), took
    numbers = np.arange(problem.goals, dtype=float)[:, None, None]
    player: Player = Idle() if method == "idle" else Chance()
    if method == "script":
        numbers, player = np.zeros((problem.goals, *usual.shape)) + SCRIPTS[task], usual
    problem.player = player
    played = problem.play(goals, numbers)
    problem.player = usual
    return played, {"evaluations": 0, "cpu_s_a_goal": 0.0}


def main() -> None:
    """Measure what has no row yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ports.jsonl"))
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU seconds a goal to search")
    parser.add_argument("--plans", type=Path, help="folder for what was found, as .npy")
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = {key(row): row for row in map(json.loads, lines)}
    for task in options.tasks:
        problem: EpisodeProblem | None = None
        for method in options.methods:
            row = {
                "task": task, "method": method, "goals": options.goals,
                "seconds": options.seconds if method in SEARCHES else 0.0,
            }  # fmt: skip
            suits = task in HELD if method in DESCENTS else method != "script" or task in SCRIPTS
            if key(row) in rows or not suits:
                continue
            seeds = range(10_000, 10_000 + options.goals)
            made = HeldProblem if task in HELD else EpisodeProblem
            problem = problem or made(task, seeds, worlds=-(-options.goals // 8) * 8)
            played, took = played_by(problem, task, method, options.seconds)
            row |= {**told(played), **took, "revision": asdict(running_revision())}
            rows[key(row)] = row
            print(json.dumps(row), flush=True)
            if options.plans:
                np.save(options.plans / f"{task}-{method}.npy", played.actions)
            written = [json.dumps(rows[each]) for each in sorted(rows)]
            options.out.write_text("\n".join(written) + "\n")


def key(row: dict[str, Any]) -> tuple[str, str, int, float]:
    """What a row is the only one of."""
    return row["task"], row["method"], row["goals"], row["seconds"]


if __name__ == "__main__":
    main()
