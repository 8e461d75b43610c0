"""Agents on bags as they start here, and on bags that start wider open.

    python benchmarks/wide_bags.py [--tasks T...] [--agents A...] [--demos N] [--steps N]
                                   [--episodes N] [--work FOLDER] [--out FILE]

A cell is a task, an agent and who chooses the lift: the agent, or the paper's rule, which reads the
simulator. The wide bag is not pushed at the start, and its seam is softer: of what hardness.py
tried, its demonstrations come nearest to the original's in actions; `paper_percent` is the paper's
of the task that it varies. By default cells have a hundred scripted demonstrations of their task
and the steps of `fast`; seed 0, and the last snapshot plays the test episodes, so nothing is
chosen. Each finished cell is a line of OUT, and a cell with a line is left out: the command goes on
after an interruption. As a module of tasks it serves the command line:

    warp-deform demo bag-items-1-wide --task-module benchmarks/wide_bags.py -n 100 --out demos
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from learning.evaluation.paper_results import read_paper
from learning.evaluation.run import evaluate_run
from learning.training.config import TrainConfig
from learning.training.schedules import preset_schedule
from learning.training.settings import AgentName
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp
from warp_deform.support.revision import running_revision
from warp_deform.tasks.bag_items import BagItems1, BagItems2
from warp_deform.tasks.registration import register_task

RESULTS = Path("benchmarks/results/wide_bags.jsonl")
AGENTS: tuple[AgentName, ...] = ("gt-mlp", "gt-mlp-2step", "transporter")
Rule = Literal["action", "privileged"]
DEMOS = 100
SEAM = 120.0
"""Stiffness of a wide bag's ring [N/m], little more than half of ours."""


@register_task
class WideBagItems1(BagItems1):
    """bag-items-1 with a bag that starts wider open."""

    name = "bag-items-1-wide"
    instruction = BagItems1.instruction
    bag = replace(BagItems1.bag, ring_stiffness=SEAM)
    pushes = 0


@register_task
class WideBagItems2(BagItems2):
    """bag-items-2 with a bag that starts wider open."""

    name = "bag-items-2-wide"
    instruction = BagItems2.instruction
    bag = replace(BagItems2.bag, ring_stiffness=SEAM)
    pushes = 0


NARROW = {WideBagItems1.name: BagItems1.name, WideBagItems2.name: BagItems2.name}
"""The task of the benchmark that each wide one varies."""
TASKS = tuple(name for pair in zip(NARROW.values(), NARROW, strict=True) for name in pair)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=AGENTS)
    parser.add_argument("--demos", type=int, default=DEMOS)
    parser.add_argument("--steps", type=int, help="in place of the schedule's")
    parser.add_argument("--episodes", type=int, default=100, help="of the test")
    parser.add_argument("--work", type=Path, default=Path("wide-bags"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    quiet_warp()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    keys = ("task", "agent", "stage_rule", "demos", "steps", "n_episodes")
    done = {tuple(row[key] for key in keys) for row in map(json.loads, lines)}
    for task, agent, rule in product(options.tasks, options.agents, get_args(Rule)):
        sees: Literal["pictures", "state"] = "pictures" if agent == "transporter" else "state"
        schedule = preset_schedule("fast", task=task, demos=options.demos, sees=sees)
        steps = options.steps or schedule.steps
        if (task, agent, rule, options.demos, steps, options.episodes) not in done:
            row = json.dumps(cell(task, agent, rule, steps, options))
            options.out.parent.mkdir(parents=True, exist_ok=True)
            with options.out.open("a") as file:
                file.write(row + "\n")
            print(row)


def cell(
    task: str, agent: AgentName, rule: Rule, steps: int, options: argparse.Namespace
) -> dict[str, Any]:
    """Demonstrate and train where that has not been done, and test."""
    size = f"{options.demos}-{steps}"
    demos, run = options.work / f"{task}-demos", options.work / f"{task}-{agent}-{size}"
    collected = collect(CollectConfig(task=task, episodes=options.demos, out=demos, workers=1))
    train(
        TrainConfig(
            task=task,
            agent=agent,
            preset="fast",
            data=demos,
            demos=options.demos,
            steps=steps,
            snapshots=1,
            validate=0,
            out=run,
        )
    )
    info = evaluate_run(
        run, episodes=options.episodes, validation_episodes=1, stage_rule=rule, workers=1
    )
    test = info["test"]
    paper = read_paper().values.get((NARROW.get(task, task), agent, options.demos))
    return {
        "task": task,
        "agent": agent,
        "stage_rule": rule,
        "demos": options.demos,
        "demonstrated_actions": collected.mean_actions,
        "n_success": test["n_success"],
        "n_success_enclosed": test["n_success_enclosed"],
        "n_episodes": test["n_episodes"],
        "mean_score": test["mean_score"],
        "mean_actions": test["mean_actions"],
        "failures": test["failures"],
        "training_cpu_s": info["training_cpu_seconds"],
        "paper_percent": paper,
        "steps": info["trained_steps"],
        "commit": running_revision().commit,
    }


if __name__ == "__main__":
    main()
