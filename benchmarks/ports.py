"""Ports of published control tasks: what doing nothing, chance, a script and searches come to.

    python benchmarks/ports.py [--tasks TASK...] [--methods METHOD...] [--evaluations N]

Goals are those of 4 test seeds from 10,000; means over them. "idle" does nothing, "random" draws
actions evenly, one plan a seed, "script" is `FoldPlayer` or `SpreadPlayer` with fixed picks, where
a task has one, "cem" and "cmaes" are `optimize` over the plans of `EpisodeProblem`. A total is the
sum of the scores of all steps, DLO-Lab's return; a score is that of the end; away is the task's
loss at the end; solved and guards are shares at the end. Rows of other tasks and methods stay in
the file.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from warp_deform.control import EpisodeProblem, optimize
from warp_deform.control.episode_problem import PlayedPlans
from warp_deform.control.plan_players import FoldPlayer, Player, SpreadPlayer

GOALS = 4
TASKS = ("push-cable", "fold-fabric-3", "unfold-fabric-1", "unfold-fabric-3", "gather")
CORNERS = np.array([[-1, -1, -0.1, -0.1], [1, -1, 0.1, -0.1], [-1, 1, -0.1, 0.1]])
"""Picks and places of fold-fabric-3, see `FoldPlayer`."""


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
    """Means over the goals."""
    return {
        "score": float(played.scores.mean()),
        "total": float(played.returns.mean()),
        "away": float(np.nanmean(played.losses)) if np.isfinite(played.losses).any() else -1.0,
        "solved": float(played.solved.mean()),
        "guards": float((~np.isfinite(played.losses)).mean()),
    }


def played_by(problem: EpisodeProblem, method: str, evaluations: int) -> tuple[PlayedPlans, float]:
    """What a method's plans come to, and what it took in CPU seconds."""
    usual, numbers = problem.player, np.arange(GOALS, dtype=float)[:, None, None]
    if method in ("cem", "cmaes"):
        found = optimize(problem, method, evaluations=evaluations)
        return problem.play(range(GOALS), found.numbers), found.cpu_seconds
    player: Player = Idle() if method == "idle" else Chance()
    if method == "script":
        assert isinstance(usual, FoldPlayer), "others have no script"
        numbers, player = np.zeros((GOALS, *usual.shape)), usual
        if usual.flat == "particle_q":
            numbers += CORNERS
        else:
            player = SpreadPlayer(usual.control, usual.flat, usual.columns, usual.shape[0])
    problem.player = player
    played = problem.play(range(GOALS), numbers)
    problem.player = usual
    return played, 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ports.jsonl"))
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--methods", nargs="+", default=["idle", "random", "script", "cem"])
    parser.add_argument("--evaluations", type=int, default=100)
    parser.add_argument("--plans", type=Path, help="folder for what was found, as .npy")
    options = parser.parse_args()
    rows = {}
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row = json.loads(line)
            rows[row["task"], row["method"]] = row
    for task in options.tasks:
        problem = EpisodeProblem(task, range(10_000, 10_000 + GOALS))
        for method in options.methods:
            if method == "script" and "fabric" not in task:
                continue
            played, seconds = played_by(problem, method, options.evaluations)
            searched = options.evaluations if seconds else 0
            row = {
                "task": task, "method": method, "goals": GOALS, "evaluations": searched,
                **told(played), "cpu_s_a_goal": seconds / GOALS,
            }  # fmt: skip
            rows[task, method] = row
            print(json.dumps(row), flush=True)
            if options.plans:
                np.save(options.plans / f"{task}-{method}.npy", played.actions)
            lines = [json.dumps(rows[key]) for key in sorted(rows)]
            options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
