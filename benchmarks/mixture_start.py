"""What lets a baseline of long states use one Gaussian alone: where the mixture's means start.

    python benchmarks/mixture_start.py [--tasks T...] [--agents A...] [--demos N...] [--seeds S...]
                                       [--steps N] [--episodes N] [--work FOLDER] [--out FILE]

A baseline is trained as in the table, once as it is (its means start apart), and once with means
that start from the same weights, but for their biases. Both play the same fresh episodes.
`gaussians` is how many are in use, by 2-Step for the pick: the exponential of the entropy of the
mixing weights, 1 to 26, averaged over the demonstrations' states. `gaussians_a_state` is the mean
of what single states use. Runs and demonstrations are in WORK, and a cell with a line in OUT is
left out: the command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args
from unittest.mock import patch

import numpy as np
import torch

from learning.data.dataset import Demonstrations
from learning.evaluation.run import evaluate_run
from learning.models.gt_state import GtState, MixtureMLP
from learning.policy.policy import StatePolicy, load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import preset_schedule
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp

RESULTS = Path("benchmarks/results/mixture_start.jsonl")
Agent = Literal["gt-mlp", "gt-mlp-2step"]
STARTS = ("apart", "together")
FIRST_SEED = 60_000
"""Of the episodes that are played, which no run validates or tests on."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=("fabric-cover",))
    parser.add_argument("--agents", nargs="+", choices=get_args(Agent), default=("gt-mlp",))
    parser.add_argument("--demos", nargs="+", type=int, default=(100,))
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2))
    parser.add_argument("--steps", type=int, help="in place of the schedule's")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--work", type=Path, default=Path("mixture-start"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    quiet_warp()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    keys = ("task", "agent", "demos", "seed", "start", "steps", "n_episodes")
    done = {tuple(row[key] for key in keys) for row in map(json.loads, lines)}
    cells = product(options.tasks, options.agents, options.demos, options.seeds, STARTS)
    for task, agent, demos, seed, start in cells:
        schedule = preset_schedule("fast", task=task, demos=demos, sees="state")
        steps = options.steps or schedule.steps
        if (task, agent, demos, seed, start, steps, options.episodes) not in done:
            row = json.dumps(cell(task, agent, demos, seed, start, steps, options))
            options.out.parent.mkdir(parents=True, exist_ok=True)
            with options.out.open("a") as file:
                file.write(row + "\n")
            print(row, flush=True)


def cell(
    task: str,
    agent: Agent,
    demos: int,
    seed: int,
    start: str,
    steps: int,
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Demonstrate and train where that has not been done, and play."""
    folder = options.work / f"{task}-demos"
    collect(CollectConfig(task=task, episodes=max(options.demos), out=folder, workers=1))
    run = options.work / f"{task}-{agent}-{demos}-{steps}-{start}-{seed}"
    with starting(start):
        train(
            TrainConfig(
                task=task,
                agent=agent,
                preset="fast",
                data=folder,
                demos=demos,
                seed=seed,
                steps=steps,
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
        "start": start,
        "seed": seed,
        "steps": steps,
        "trained_steps": info["trained_steps"],
        "gaussians": gaussians,
        "gaussians_a_state": a_state,
        "n_success": played["n_success"],
        "n_episodes": played["n_episodes"],
        "paper_value": played["paper_value"],
        "commit": RunFolder(run).read_settings()["revisions"][0]["commit"],
    }


@contextmanager
def starting(start: str) -> Iterator[None]:
    """Mixtures that are made meanwhile have means that start `apart` or `together`."""
    draw = MixtureMLP._draw_weights

    def drawn(network: MixtureMLP, generator: torch.Generator) -> None:
        draw(network, generator)
        if start == "together":
            weights = network.mean.weight.data.unflatten(0, (network.config.n_gaussians, -1))
            weights[:] = weights[:1].clone()

    with patch.object(MixtureMLP, "_draw_weights", drawn):
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
