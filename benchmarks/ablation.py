"""What makes `fast` learn from few demonstrations: variants, trained alike, on unseen ones.

    python benchmarks/ablation.py [--task cable-shape] [--variants fast "no skips" ...]

Every variant differs from `fast` in one thing, and sees the same demonstrations for as many steps
(as many pictures where the batch is larger). It is judged on demonstrations of validation seeds: by
the mean negative log-likelihood of the demonstrator's pick and place [nat], and by the distance of
the most probable place from the demonstrator's, given the pick: its median [mm] and the share below
20 mm. With --episodes also by how it plays validation seeds, without retries. Rows are added to
--out; those that it has are not made again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch.nn import functional

from learning.data.dataset import Demonstrations
from learning.evaluation.protocol import Protocol
from learning.evaluation.snapshot import evaluate_snapshot
from learning.models.transporter import PRESETS
from learning.policy.policy import ImagePolicy, load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import SCHEDULES
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import task as find_task

FAST = PRESETS["fast"]
PLAN = SCHEDULES["fast"]
VARIANTS: dict[str, dict[str, Any]] = {
    "fast": {},
    "no skips": {"network": replace(FAST, skips=False)},
    "not equivariant": {"network": replace(FAST, equivariant=False)},
    "no gain": {"network": replace(FAST, gain=1.0)},
    "no focus": {"network": replace(FAST, focus=0.0)},
    "coarse image": {"network": replace(FAST, fine=False)},
    "no mark": {"network": replace(FAST, mark_pick=False)},
    "picture framed": {"network": replace(FAST, pad_features=False)},
    "no goal bias": {"network": replace(FAST, goal_bias=0.0)},
    "width of 1/2": {"network": replace(FAST, width=0.5)},
    "crop of 64": {"network": replace(FAST, crop=64)},
    "no augmentation": {"augment": False},
    "no mirror images": {"schedule": replace(PLAN, mirror=False)},
    "no averaging": {"schedule": replace(PLAN, ema=0.0)},
    "no decay": {"schedule": replace(PLAN, decay=False)},
    "half the step size": {"schedule": replace(PLAN, lr=PLAN.lr / 2)},
    "twice the step size": {"schedule": replace(PLAN, lr=PLAN.lr * 2)},
    "batch of 4": {"schedule": replace(PLAN, batch=4)},
    "soft labels": {"soft": 1.5},
}
"""What differs from `fast`; `soft`: labels are Gaussians of that standard deviation [pixels]."""
VALIDATION_SEED = 50_000
NEAR_MM = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--task", default="cable-shape")
    parser.add_argument("--demos", type=int, default=10)
    parser.add_argument("--held-out", type=int, default=30, help="demonstrations to be judged on")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=0, help="validation episodes to play")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--folder", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--out", type=Path, default=Path("runs/ablation.jsonl"))
    options = parser.parse_args()
    quiet_warp()
    rows = []
    for name in options.variants:
        rows.append(judge(name, options))
        print(json.dumps(rows[-1]), flush=True)
    print(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown of rows, as in docs/learning.md."""
    lines = [
        "| variant | pick [nat] | place [nat] | place, median [mm] | within 20 mm | CPU s |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        name = row["variant"] + (f", seed {row['seed']}" if row["seed"] else "")
        lines.append(
            f"| {name} | {row['pick_nat']:.2f} | {row['place_nat']:.2f} | {row['place_mm']:.1f} "
            f"| {100 * row['near']:.0f} % | {row['cpu_s']:.0f} |"
        )
    return "\n".join(lines)


def judge(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """The variant's row: from the file, or made now."""
    what = {"task": options.task, "demos": options.demos, "steps": options.steps,
            "seed": options.seed, "variant": name, "episodes": options.episodes}  # fmt: skip
    if options.out.exists():
        for line in options.out.read_text().splitlines():
            row: dict[str, Any] = json.loads(line)
            if all(row[key] == value for key, value in what.items()):
                return row
    data = {
        split: options.folder / f"{options.task}-{split}" for split in ("training", "validation")
    }
    collect(CollectConfig(task=options.task, episodes=options.demos, out=data["training"]))
    collect(
        CollectConfig(
            task=options.task,
            episodes=options.held_out,
            seed=VALIDATION_SEED,
            out=data["validation"],
        )
    )
    changes = dict(VARIANTS[name])
    soft = changes.pop("soft", None)
    plan = changes.pop("schedule", PLAN)
    plan = replace(plan, steps=options.steps // plan.batch, snapshots=1, validate=0)
    agent = "goal-split" if find_task(options.task).goal_conditioned else "transporter"
    label = "-".join(str(value) for value in what.values()).replace(" ", "_")
    run = RunFolder(options.folder / label)
    began = time.process_time()
    config = TrainConfig(
        task=options.task,
        agent=agent,
        data=data["training"],
        out=run.path,
        seed=options.seed,
        preset="fast",
        schedule=plan,
        **changes,
    )
    with soft_labels(soft) if soft else contextlib.nullcontext():
        train(config)
    row = {**what, "agent": agent, "cpu_s": time.process_time() - began}
    row |= held_out(run, Demonstrations(data["validation"], task=options.task))
    if options.episodes:
        protocol = Protocol(split="validation", episodes=options.episodes, retry=False)
        summary = evaluate_snapshot(run, plan.steps, protocol).summary
        row |= {key: summary[key] for key in ("mean_score", "standard_error", "pc_success")}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("a") as file:
        file.write(json.dumps(row) + "\n")
    return row


@contextlib.contextmanager
def soft_labels(deviation: float) -> Iterator[None]:
    """Have heat maps learn Gaussians around their labels, of a deviation in pixels."""
    plain, (rows, columns) = functional.cross_entropy, FAST.shape

    def soft(logits: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        if logits.shape[1] % (rows * columns):
            return plain(logits, label)  # of lifts
        layer, at = label // (rows * columns), label % (rows * columns)
        row, column = at // columns, at % columns
        squares = (torch.arange(rows) - row[:, None])[:, :, None] ** 2 + (
            torch.arange(columns) - column[:, None]
        )[:, None] ** 2
        target = torch.zeros(len(label), logits.shape[1] // (rows * columns), rows * columns)
        wanted = torch.softmax(-squares.flatten(1) / (2 * deviation**2), dim=1)
        target[torch.arange(len(label)), layer] = wanted
        return plain(logits, target.flatten(1))

    with mock.patch.object(functional, "cross_entropy", soft):
        yield


@torch.no_grad()
def held_out(run: RunFolder, data: Demonstrations) -> dict[str, float]:
    """Likelihoods and distances over all transitions of demonstrations that were not trained on."""
    policy = load_policy(run.path)
    assert isinstance(policy, ImagePolicy)
    agent, grid = policy.agent, data.task.grid
    config = agent.config
    transitions = [(e, t) for e, length in enumerate(data.lengths()) for t in range(length)]
    likelihoods, distances = [], []
    for transition in (data.transition(*each) for each in transitions):
        goal = (transition.goal_color, transition.goal_height) if agent.pictures == 2 else None
        image = agent.image((transition.color, transition.height), goal)[None]
        pick, place = (
            torch.from_numpy(config.to_network(grid.to_pixel(xy)))[None]
            for xy in (transition.action[:2], transition.action[3:5])
        )
        turn = transition.action[2] - transition.action[5]
        n = config.n_rotations_eval
        heats = agent.attention(image), agent.transport(image, pick, n_rotations=n)[0]
        row = [
            -torch.log_softmax(heat.flatten(), 0)
            .unflatten(0, heat.shape)[k, pixel[0, 0], pixel[0, 1]]
            .item()
            for heat, pixel, k in zip(
                heats, (pick, place), (0, round(turn * n / (2 * np.pi)) % n), strict=True
            )
        ]
        likelihoods.append(row)
        best = int(heats[1].argmax()) % (config.shape[0] * config.shape[1])
        at = np.array([best // config.shape[1], best % config.shape[1]])
        distances.append(
            np.linalg.norm(grid.to_world(config.to_camera(at)) - transition.action[3:5])
        )
    millimetres = 1e3 * np.array(distances)
    picks, places = np.mean(likelihoods, axis=0)
    return {
        "moments": len(transitions),
        "pick_nat": float(picks),
        "place_nat": float(places),
        "place_mm": float(np.median(millimetres)),
        "near": float((millimetres < NEAR_MM).mean()),
    }


if __name__ == "__main__":
    main()
