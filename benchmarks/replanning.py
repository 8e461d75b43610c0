"""What a plan comes to where the world is not as it was planned for, open loop and planned again.

    python benchmarks/replanning.py [--tasks TASK...] [--rounds N...] [--goals N] [--out FILE]
    python benchmarks/replanning.py --alone [--out FILE]

Plans for 200 goals of test seeds from 10,000 are searched with 400 evaluations each, or are idle.
Then the goals are played in worlds that are disturbed: by noise on every move of the tip, or by
another damping than the plan's simulator has. "0 rounds" plays the plan as it is; with N rounds the
rest of it descends N times at every control step, see `warp_deform.control.Replanner`. One row a
task, start, disturbance and number of rounds; `step_ms` is CPU time of a control step and goal, in
lanes.

`--alone` times single goals, as a robot has them: CPU time of a step, median and longest.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learning.control.play import bootstrapped, play_control
from warp_deform.control import Replanner, SwingProblem, TensorControlWorlds, optimize
from warp_deform.quiet import quiet_warp

FIRST = 10_000  # seed
EVALUATIONS = 400
"""Of the search for a plan; one with its gradient counts 2.5."""
DISTURBANCES = {
    "none": {}, "noise-0.03": {"noise": 0.03}, "noise-0.1": {"noise": 0.1},
    "damping-x1.2": {"damping": 1.2}, "damping-x1.5": {"damping": 1.5},
    "damping-x0.7": {"damping": 0.7},
}  # fmt: skip
"""Standard deviation of each number of a move (1 is the tip's greatest speed), and factors."""


def played(
    worlds: TensorControlWorlds, act: Replanner, *, noise: float = 0.0, damping: float = 1.0
) -> tuple[Any, float]:
    """The ends of the goals' episodes, and the CPU time of acting [s]."""
    solver, spent = worlds.worlds.solver, [0.0]
    usual = solver.config.damping
    rng = np.random.default_rng(0)

    def pushed(seen: torch.Tensor) -> torch.Tensor:
        if not worlds.steps.any():  # a reset has put the usual damping back
            for world in range(worlds.worlds.count):
                solver.set_world(world, damping=damping * usual)
        began = time.process_time()
        actions = act(seen.numpy())
        spent[0] += time.process_time() - began
        actions[:, :3] += noise * rng.normal(size=(len(actions), 3))
        return torch.from_numpy(actions)

    goals = act.problem.goals
    ends = play_control(worlds, pushed, range(FIRST, FIRST + goals))
    return ends, spent[0]


def alone(task: str, rounds: int, goals: int = 10) -> dict[str, Any]:
    """CPU milliseconds of a step of single goals."""
    times = []
    for seed in range(FIRST, FIRST + goals):
        problem = SwingProblem(task, [seed], worlds=8)
        idle = np.zeros((1, 1, *problem.shape))
        problem.evaluate(idle)  # this and the next line compile kernels, once
        problem.gradients(idle[:, 0], np.arange(1))
        plan = optimize(problem, evaluations=EVALUATIONS).numbers
        worlds = TensorControlWorlds(task, 1, start="held", action_penalty=0.0)
        worlds.reset({0: seed})
        act = Replanner(problem, plan, rounds=rounds)
        while worlds.running.any():
            seen = worlds.observe().numpy()
            began = time.process_time()
            actions = act(seen)
            times.append(1000 * (time.process_time() - began))
            worlds.advance(torch.from_numpy(actions))
    steps = np.array(times).reshape(goals, -1)[:, 1:]  # the first is not planned again
    return {
        "task": task, "start": "alone", "disturbance": "none", "rounds": rounds, "goals": goals,
        "median_ms": float(np.median(steps)), "most_ms": float(steps.max()),
    }  # fmt: skip


def main() -> None:
    """Measure, and print rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=["whip-target", "whip"])
    parser.add_argument("--starts", nargs="+", default=["planned"], choices=["planned", "idle"])
    parser.add_argument("--disturbances", nargs="+", default=list(DISTURBANCES))
    parser.add_argument("--rounds", nargs="+", type=int, default=[0, 8])
    parser.add_argument("--goals", type=int, default=200, help="a multiple of 8")
    parser.add_argument("--alone", action="store_true", help="time single goals")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/replanning.jsonl"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    quiet_warp()
    rows = {}
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row = json.loads(line)
            rows[row["task"], row["start"], row["disturbance"], row["rounds"]] = row

    def keep(row: dict[str, Any]) -> None:
        row["load"] = os.getloadavg()[0]
        rows[row["task"], row["start"], row["disturbance"], row["rounds"]] = row
        print(json.dumps(row), flush=True)
        options.out.write_text("".join(f"{json.dumps(rows[key])}\n" for key in sorted(rows)))

    for task in options.tasks:
        if options.alone:
            for rounds in options.rounds:
                keep(alone(task, rounds))
            continue
        problem = SwingProblem(task, range(FIRST, FIRST + options.goals))
        idle = np.zeros((options.goals, *problem.shape))
        problem.evaluate(idle[:, None])  # this and the next line compile kernels
        problem.gradients(idle, np.arange(options.goals))
        worlds = TensorControlWorlds(task, options.goals, start="held", action_penalty=0.0)
        for start in options.starts:
            plans = idle
            if start == "planned":
                plans = optimize(problem, evaluations=EVALUATIONS).numbers
            for disturbance in options.disturbances:
                for rounds in options.rounds:
                    act = Replanner(problem, plans, rounds=rounds)
                    ends, spent = played(worlds, act, **DISTURBANCES[disturbance])
                    low, high = bootstrapped(ends.scores)
                    fine = ends.left[np.isfinite(ends.left)]
                    keep({
                        "task": task, "start": start, "disturbance": disturbance,
                        "rounds": rounds, "goals": options.goals,
                        "mean_cm": float(100 * fine.mean()),
                        **{f"within_{cm}_cm": int((ends.left < cm / 100).sum())
                           for cm in (10, 5, 2, 1)},
                        "score": float(ends.scores.mean()), "score_low": low, "score_high": high,
                        "guards": int((~np.isfinite(ends.left)).sum()),
                        "step_ms": 1000 * spent / options.goals / (problem.horizon - 1),
                    })  # fmt: skip


if __name__ == "__main__":
    main()
