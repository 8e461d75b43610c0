"""Which search makes recorded trajectories better: all methods at equal CPU seconds an episode.

    python benchmarks/trajectory_study.py [--tasks TASK...] [--methods METHOD...] [--episodes N]
                                          [--seconds S] [--work FOLDER] [--out FILE]

Demonstrations at 20 Hz are made once, in WORK. Every method then has S CPU seconds for each, with
the same problem, see `TrajectoryProblem`: its loss is the mean ratio to the recording of steps,
what is left to do, and roughness, so that the recording has 1. A row a task and method holds the
mean loss of the best plans with its 95 % interval (bootstrap over episodes), how many beat the
recording in one measure and are worse in none, and the three ratios of those. What has a row is
left out, so the command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from learning.control.play import bootstrapped
from warp_deform.collecting.control_episodes import control_worlds
from warp_deform.collecting.control_replay import setup_of
from warp_deform.command.main import main as warp_deform
from warp_deform.control import optimize
from warp_deform.control.trajectory_measures import Walk
from warp_deform.control.trajectory_problem import TrajectoryProblem
from warp_deform.episodes import EpisodeReader
from warp_deform.support.revision import running_revision

TASKS = ("cable-shape", "fabric-flat", "bag-alone-open")
METHODS = ("random", "cem", "cmaes", "adam", "lbfgs", "cem+adam")
POPULATION = 24
"""Plans of a round: three groups of lanes, as `refine --trajectories` has them."""


def main() -> None:
    """Measure what has no row yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0, help="CPU seconds an episode")
    parser.add_argument("--horizon", type=int, default=600)
    parser.add_argument("--work", type=Path, default=Path("trajectory-study"))
    parser.add_argument(
        "--out", type=Path, default=Path("benchmarks/results/trajectory_study.jsonl")
    )
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = {key(row): row for row in map(json.loads, lines)}
    for task in options.tasks:
        for method in options.methods:
            row = {
                "task": task, "method": method,
                "episodes": options.episodes, "seconds": options.seconds,
            }  # fmt: skip
            if key(row) in rows:
                continue
            row |= measured(demonstrations(task, options), method, options.seconds)
            row["revision"] = asdict(running_revision())
            rows[key(row)] = row
            print(json.dumps(row), flush=True)
            options.out.write_text("".join(json.dumps(rows[each]) + "\n" for each in sorted(rows)))


def key(row: dict[str, Any]) -> tuple[str, str, int, float]:
    """What a row is the only one of."""
    return row["task"], row["method"], row["episodes"], row["seconds"]


def demonstrations(task: str, options: argparse.Namespace) -> Path:
    """A folder of the task's demonstrations."""
    folder: Path = options.work / task
    command = [
        "demo", task, "--control", "--start", "held", "--horizon", str(options.horizon),
        "-n", str(options.episodes), "--out", str(folder),
    ]  # fmt: skip
    if warp_deform(command):
        raise SystemExit(f"{task} has no demonstrations")
    return folder


def measured(folder: Path, method: str, seconds: float) -> dict[str, Any]:
    """What a method comes to on the episodes of a folder."""
    reader = EpisodeReader(folder, control=True)
    control = control_worlds(setup_of(reader.infos()[0]))
    losses, ratios, evaluations, cpu = [], [], 0, 0.0
    for seed in reader.seeds:
        actions = [step.action for step in reader.read(seed).steps if step.action is not None]
        problem = TrajectoryProblem(control, seed, np.array(actions))
        found = optimize(problem, method, seconds=seconds, population=POPULATION, seed=seed)
        losses.append(min(1.0, float(found.losses[0])))  # else the recording is kept
        walk = problem.walks(found.numbers[0][None])[0]
        if walk.beats(problem.recorded):
            ratios.append(over(walk, problem.recorded))
        evaluations += found.evaluations
        cpu += found.cpu_seconds
    low, high = bootstrapped(np.array(losses))
    steps, left, rough = np.mean(ratios, axis=0) if ratios else (None, None, None)
    return {
        "loss": float(np.mean(losses)), "loss_low": low, "loss_high": high,
        "improved": len(ratios), "steps": steps, "left": left, "roughness": rough,
        "evaluations": evaluations / len(losses), "cpu_s": cpu / len(losses),
    }  # fmt: skip


def over(walk: Walk, recorded: Walk) -> np.ndarray:
    """Ratios to the recording: steps, what is left to do, roughness."""
    assert walk.measures is not None and recorded.measures is not None, "no guard has fired"
    return walk.measures.over(recorded.measures)


if __name__ == "__main__":
    main()
