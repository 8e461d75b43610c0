"""What cloned policies come to on tasks of control, on seeds held out.

    python benchmarks/cloning.py [TASK...] [--demos N] [--refined | --planned] [--seed S]
                                 [--episodes N] [--work DIR] [--out FILE]

For every task it collects demonstrations at 20 Hz with seeds from 0 (unless the work folder has
them), clones them in chunks on one thread, and keeps five snapshots, evenly spread. Each plays 32
validation episodes with seeds from 50,000; the best by its successes, then by its score, plays test
episodes with seeds from 10,000, which nothing was chosen on. With --refined the demonstrations are
refined as trajectories first. With --planned a swing is demonstrated by a network that plans it,
trained for a minute, in place of a search for one goal after the other; its training counts as
collecting. One row a task and source of data, appended to the results: successes
with Wilson's 95 % interval [%], of swings how many came within 10, 5, 2 and 1 cm, mean score, mean
steps of the solved, CPU seconds of the updates, and of what collected and refined.
cable-line-notarget begins with the first bead held and has 600
steps.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learning.control.cloning import (
    ChunkPolicy,
    Cloner,
    CloningConfig,
    PlayedClone,
    play_clone,
    read_chunks,
)
from learning.control.demonstrate import demonstrate
from learning.control.train import ControlTrainConfig, train_control
from learning.evaluation.protocol import FIRST_SEED
from learning.evaluation.summary import wilson
from learning.refinement.trajectories import TrajectoryConfig, refine_trajectories
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.control.whip import WhipTarget
from warp_deform.quiet import quiet_warp

TASKS: dict[str, dict[str, Any]] = {
    "block-notarget": {},
    "whip-target": {"evaluations": 250},
    "cable-line-notarget": {"start": "held", "horizon": 600},
}
SNAPSHOTS, VALIDATE = 5, 32
DISTANCE = {
    "whip-target": lambda score: -WhipTarget.tolerance * np.log2(score),
    "whip": lambda score: -np.log(score) / 10,
}
"""How far the end, or the beads over the square root of 3, are from the goal by the score [m]."""


def main() -> None:
    """Collect, clone, choose, test, and append rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="*", default=list(TASKS), metavar="TASK")
    parser.add_argument("--demos", type=int, default=100)
    parser.add_argument("--updates", type=int, default=CloningConfig.updates)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--refined", action="store_true")
    source.add_argument("--planned", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--work", type=Path, default=Path("build/cloning"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/cloning.jsonl"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    quiet_warp()
    for task in options.tasks:
        row = cloned(task, options)
        with options.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)


def cloned(task: str, options: argparse.Namespace) -> dict[str, Any]:
    """The row of a task."""
    began = time.process_time()
    folder = options.work / task
    if options.planned:
        run, folder = options.work / f"{task}-run", options.work / f"{task}-planned"
        train_control(ControlTrainConfig(task=task, method="plan", minutes=1.0, out=run))
        demonstrate(run, folder, episodes=options.demos)
    else:
        collect(
            CollectConfig(
                task=task, episodes=options.demos, out=folder, workers=1, control=True,
                **TASKS[task],
            )
        )  # fmt: skip
    if options.refined:
        refined = options.work / f"{task}-refined"
        refine_trajectories(TrajectoryConfig(source=folder, out=refined, workers=1))
        folder = refined
    collected = time.process_time() - began
    config = CloningConfig(updates=options.updates)
    chunks = read_chunks(folder, config.chunk)
    cloner = Cloner(chunks, config, seed=options.seed)
    due = {round(config.updates * (k + 1) / SNAPSHOTS) for k in range(SNAPSHOTS)}
    spent, best = 0.0, (-1, -1.0)
    chosen: dict[str, Any] = {}
    for number in range(1, config.updates + 1):
        began = time.process_time()
        loss = cloner.update(number)
        spent += time.process_time() - began
        if number in due:
            played = play(chunks.how, cloner.policy, "validation", VALIDATE)
            grade = sum(p.solved for p in played), float(np.mean([p.score for p in played]))
            if grade >= best:
                weights = {k: v.clone() for k, v in cloner.policy.state_dict().items()}
                chosen, best = {"weights": weights, "step": number, "loss": loss}, grade
    cloner.policy.load_state_dict(chosen["weights"])
    played = play(chunks.how, cloner.policy, "test", options.episodes)
    solved = [p for p in played if p.solved]
    low, high = wilson(len(solved), len(played))
    within: dict[str, int] = {}
    if task in DISTANCE:
        away = DISTANCE[task](np.array([max(p.score, 1e-9) for p in played]))
        within = {f"within_{cm}_cm": int((away < cm / 100).sum()) for cm in (10, 5, 2, 1)}
    return {
        "task": task,
        "data": "planned" if options.planned else "refined" if options.refined else "demonstrated",
        "demos": options.demos,
        "rows": len(chunks.seen),
        "seed": options.seed,
        "updates": config.updates,
        "selected": chosen["step"],
        "loss": chosen["loss"],
        "validation": best[0],
        "n_episodes": len(played),
        "n_success": len(solved),
        "low": low,
        "high": high,
        **within,
        "mean_score": float(np.mean([p.score for p in played])),
        "mean_steps": float(np.mean([p.steps for p in solved])) if solved else None,
        "guards": sum(p.ended.startswith("physics") for p in played),
        "cpu_s": spent,
        "collect_cpu_s": collected,
    }


def play(how: Any, policy: ChunkPolicy, kind: str, count: int) -> list[PlayedClone]:
    """What came of the first seeds of a kind."""
    first = FIRST_SEED[kind]
    return list(play_clone(how, policy, range(first, first + count)).values())


if __name__ == "__main__":
    main()
