"""Whether cosines less one, and equal weights at first, keep more Gaussians of a baseline in use.

    python benchmarks/gaussians_in_use.py [--tasks T...] [--agents A...] [--demos N...]
        [--seeds S...] [--ways W...] [--steps N] [--episodes N] [--work FOLDER] [--out FILE]

A baseline is trained in four ways: as in the table (`both`), with cosines that are seen whole
(`even`), with Gaussians whose weights are learnt from the first step on (`less-one`), and with
neither, as in the paper. All play the same fresh episodes. `gaussians` is how many are in use,
by 2-Step for the pick: the exponential of the entropy of the mixing weights, 1 to 26, averaged over
the demonstrations' states. `gaussians_a_state` is the mean of what single states use. Runs and
demonstrations are in WORK, and a cell with a line in OUT is left out: the command goes on after an
interruption.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args
from unittest.mock import patch

import numpy as np
import torch

from learning.data.dataset import Demonstrations
from learning.evaluation.run import evaluate_run
from learning.models.gt_state import GtState, GtStateConfig
from learning.policy.policy import StatePolicy, load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule, preset_schedule
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp

RESULTS = Path("benchmarks/results/gaussians_in_use.jsonl")
Agent = Literal["gt-mlp", "gt-mlp-2step"]
WAYS = {
    "neither": (False, False),
    "even": (False, True),
    "less-one": (True, False),
    "both": (True, True),
}
"""Whether cosines are seen less one, and whether Gaussians weigh the same at first."""
FIRST_SEED = 60_000
"""Of the episodes that are played, which no run validates or tests on."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=("fabric-cover",))
    parser.add_argument("--agents", nargs="+", choices=get_args(Agent), default=("gt-mlp",))
    parser.add_argument("--demos", nargs="+", type=int, default=(100,))
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=tuple(WAYS))
    parser.add_argument("--steps", type=int, help="in place of the schedule's")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--work", type=Path, default=Path("gaussians-in-use"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    quiet_warp()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    keys = ("task", "agent", "demos", "seed", "way", "steps", "n_episodes")
    done = {tuple(row[key] for key in keys) for row in map(json.loads, lines)}
    cells = product(options.tasks, options.agents, options.demos, options.seeds, options.ways)
    for task, agent, demos, seed, way in cells:
        plan = preset_schedule("fast", task=task, demos=demos, sees="state")
        even = plan.even if WAYS[way][1] else 0.0
        plan = replace(plan, even=even, steps=options.steps or plan.steps)
        if (task, agent, demos, seed, way, plan.steps, options.episodes) not in done:
            row = json.dumps(cell(task, agent, demos, seed, way, plan, options))
            options.out.parent.mkdir(parents=True, exist_ok=True)
            with options.out.open("a") as file:
                file.write(row + "\n")
            print(row, flush=True)


def cell(
    task: str,
    agent: Agent,
    demos: int,
    seed: int,
    way: str,
    plan: Schedule,
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Demonstrate and train where that has not been done, and play."""
    folder = options.work / f"{task}-demos"
    collect(CollectConfig(task=task, episodes=max(options.demos), out=folder, workers=1))
    run = options.work / f"{task}-{agent}-{demos}-{plan.steps}-{way}-{seed}"
    with seeing(less_one=WAYS[way][0]):
        train(
            TrainConfig(
                task=task,
                agent=agent,
                preset="fast",
                data=folder,
                demos=demos,
                seed=seed,
                schedule=plan,
                out=run,
                threads=1,
            )
        )
    info = evaluate_run(run, episodes=options.episodes, first_seed=FIRST_SEED, workers=1)
    played = info["played"]["test"]
    gaussians, a_state = in_use(run, folder, demos=demos, seed=seed)
    return {
        "task": task,
        "agent": agent,
        "demos": demos,
        "way": way,
        "seed": seed,
        "steps": plan.steps,
        "trained_steps": info["trained_steps"],
        "gaussians": gaussians,
        "gaussians_a_state": a_state,
        "n_success": played["n_success"],
        "n_episodes": played["n_episodes"],
        "paper_value": played["paper_value"],
        "commit": RunFolder(run).read_settings()["revisions"][0]["commit"],
    }


@contextmanager
def seeing(*, less_one: bool) -> Iterator[None]:
    """Baselines whose training begins meanwhile see cosines less one, or whole."""

    def chosen(**choices: Any) -> GtStateConfig:
        return GtStateConfig(**choices | {"cosines_less_one": less_one})

    with patch("learning.training.train.GtStateConfig", chosen):
        yield


@torch.no_grad()
def in_use(run: Path, folder: Path, *, demos: int, seed: int) -> tuple[float, float]:
    """Gaussians that the snapshot that plays uses of the states that it learnt from, and of one."""
    policy = load_policy(run)
    if not isinstance(policy, StatePolicy):
        raise SystemExit(f"{run} is no run of a baseline")
    network = policy.agent.network if isinstance(policy.agent, GtState) else policy.agent.pick
    learnt = Demonstrations(folder, task=policy.description.task, count=demos, seed=seed)
    states = [
        learnt.state(episode, t)[0]
        for episode, (_, actions) in enumerate(learnt.actions())
        for t in range(len(actions))
    ]
    return counted(network(torch.from_numpy(np.stack(states))).log_pi.exp())


def counted(mixing: torch.Tensor) -> tuple[float, float]:
    """Gaussians in use by mixing weights (B, K) together, and the mean of what rows use."""
    entropy = torch.special.entr(mixing).sum(dim=1)
    return float(torch.special.entr(mixing.mean(dim=0)).sum().exp()), float(entropy.exp().mean())


if __name__ == "__main__":
    main()
