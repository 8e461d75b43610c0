"""What lets a baseline of long states use one Gaussian alone: where the mixture's means start.

    python benchmarks/mixture_start.py [--tasks T...] [--agents A...] [--demos N...] [--seeds S...]
                                       [--steps N] [--episodes N] [--work FOLDER] [--out FILE]

A baseline is trained as in the table, once as it is (its means start apart), and once with means
that start from the same weights, but for their biases. Both play the same fresh episodes, and
`gaussians` is how many are in use on the demonstrations' states, by 2-Step for the pick: the
exponential of the entropy of their mean mixing weights, 1 to 26. Runs and demonstrations are in
WORK, and a cell with a line in OUT is left out: the command goes on after an interruption.
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
from learning.training.config import TrainConfig
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp
from warp_deform.support.revision import running_revision

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
    keys = ("task", "agent", "demos", "seed", "start")
    done = {tuple(row[key] for key in keys) for row in map(json.loads, lines)}
    cells = product(options.tasks, options.agents, options.demos, options.seeds, STARTS)
    for each in cells:
        if each not in done:
            row = json.dumps(cell(*each, options))
            options.out.parent.mkdir(parents=True, exist_ok=True)
            with options.out.open("a") as file:
                file.write(row + "\n")
            print(row, flush=True)


def cell(
    task: str, agent: Agent, demos: int, seed: int, start: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Demonstrate and train where that has not been done, and play."""
    folder = options.work / f"{task}-demos"
    collect(CollectConfig(task=task, episodes=max(options.demos), out=folder, workers=1))
    run = options.work / f"{task}-{agent}-{demos}-{start}-{seed}"
    with starting(start):
        train(
            TrainConfig(
                task=task,
                agent=agent,
                preset="fast",
                data=folder,
                demos=demos,
                seed=seed,
                steps=options.steps,
                out=run,
                threads=1,
            )
        )
    info = evaluate_run(run, episodes=options.episodes, first_seed=FIRST_SEED, workers=1)
    played = info["played"]["test"]
    return {
        "task": task,
        "agent": agent,
        "demos": demos,
        "start": start,
        "seed": seed,
        "steps": info["trained_steps"],
        "gaussians": in_use(run, folder, demos=demos, seed=seed),
        "n_success": played["n_success"],
        "n_episodes": played["n_episodes"],
        "paper_value": played["paper_value"],
        "commit": running_revision().commit,
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
def in_use(run: Path, folder: Path, *, demos: int, seed: int) -> float:
    """Gaussians in use by the snapshot that plays, on the states that it learnt from."""
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
    mixing = network(torch.from_numpy(np.stack(states))).log_pi.exp().mean(dim=0)
    return float(torch.special.entr(mixing).sum().exp())


if __name__ == "__main__":
    main()
