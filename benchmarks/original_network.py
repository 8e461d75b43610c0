"""The original's network beside `fast`: what the same demonstrations have taught by which CPU time.

    python benchmarks/original_network.py [--tasks T...] [--networks N...] [--minutes M]
                                          [--steps N] [--demos N] [--data FOLDER] [--episodes N]
                                          [--work FOLDER] [--out FILE] [--plot PNG]

`original` is the network of the preset `paper` in the paper's schedule of 20,000 steps, with one
place rotation in training where the paper has 24, which costs less. `fast` is the preset of
that name for all of its 4,000 steps. Both are Transporters. Data are those of `demo TASK -n 100`,
in DATA/TASK; where they are missing, they are made.

Training goes on from its last stored state (one every 100 steps), and is interrupted after so many
CPU minutes of this call. Then every snapshot without a line in OUT plays the same test episodes;
none is chosen. A line has the CPU time of the training that led to its snapshot. With --plot
nothing is trained or played, and OUT is drawn.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from learning.evaluation.protocol import Protocol
from learning.evaluation.snapshot import evaluate_snapshot
from learning.models.transporter import PRESETS
from learning.runs.folder import RunFolder
from learning.runs.log import cpu_seconds, read_log
from learning.training.config import TrainConfig
from learning.training.schedules import SCHEDULES
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.quiet import quiet_warp
from warp_deform.support.progress import progress_bar
from warp_deform.support.revision import running_revision

TASKS = ("cable-shape", "fabric-flat", "bag-items-1")
ORIGINAL_STEPS = (250, 500, 1000, 2000, 4000, 8000, 20_000)
PLANS = {
    # `snapshots` only says here how often the state is stored: every 100 steps
    "original": replace(
        SCHEDULES["paper"], shares=tuple(n / 20_000 for n in ORIGINAL_STEPS), snapshots=20
    ),
    "fast": replace(SCHEDULES["fast"], validate=0, confirm=0, patience=None),
}
NETWORKS = {"original": replace(PRESETS["paper"], n_rotations_train=1), "fast": PRESETS["fast"]}
PRESET = {"original": "paper", "fast": "fast"}
AGENT = "transporter"


class TimeIsUp(KeyboardInterrupt):
    """An interrupt that nobody asked for: training stops, and the program goes on."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=tuple(NETWORKS))
    parser.add_argument("--minutes", type=float, default=60.0, help="of a training in this call")
    parser.add_argument("--steps", type=int, help="in place of the schedules'")
    parser.add_argument("--demos", type=int, default=100)
    parser.add_argument("--data", type=Path, default=Path("demos"))
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--work", type=Path, default=Path("original-network"))
    parser.add_argument(
        "--out", type=Path, default=Path("benchmarks/results/original_network.jsonl")
    )
    parser.add_argument("--plot", type=Path, help="picture to draw of OUT")
    options = parser.parse_args()
    if options.plot is not None:
        draw(read_rows(options.out), options.plot)
        return
    quiet_warp()
    torch.set_num_threads(1)
    for task, network in product(options.tasks, options.networks):
        run = trained(task, network, options)
        for step in run.steps():
            play(run, step, task, network, options)


def trained(task: str, network: str, options: argparse.Namespace) -> RunFolder:
    """The run of a network, as far as the time allows."""
    data = options.data / task
    collect(CollectConfig(task=task, episodes=options.demos, out=data, workers=1))
    plan = PLANS[network]
    if options.steps is not None:
        plan = replace(plan, steps=options.steps)
    config = TrainConfig(
        task=task,
        agent=AGENT,
        data=data,
        demos=options.demos,
        out=options.work / f"{task}-{network}",
        preset=PRESET[network],
        network=NETWORKS[network],
        schedule=plan,
        precision="float32",
    )
    with contextlib.suppress(TimeIsUp), interrupted_after(60 * options.minutes):
        train(config)
    return RunFolder(config.out)


@contextlib.contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Interrupt the block as Ctrl-C does, once it has used so much CPU time."""

    def end(*_: object) -> None:
        raise TimeIsUp

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def play(run: RunFolder, step: int, task: str, network: str, options: argparse.Namespace) -> None:
    """Add a snapshot's row to OUT, unless it is there."""
    what = {"task": task, "network": network, "demos": options.demos, "step": step,
            "n_episodes": options.episodes}  # fmt: skip
    rows = read_rows(options.out)
    if any(all(row[key] == value for key, value in what.items()) for row in rows):
        return
    protocol = Protocol(split="test", episodes=options.episodes)
    bar = progress_bar(f"play {task}, {network}, step {step}", options.episodes, unit="episodes")
    with bar as advance:
        played = evaluate_snapshot(run, step, protocol, on_episode=lambda _: advance())
    shown = played.summary
    row = {
        **what,
        "agent": AGENT,
        "training_cpu_s": cpu_seconds(line for line in read_log(run) if line["step"] <= step),
        "n_success": shown["n_success"],
        "score": shown["mean_score"],
        "score_error": shown["standard_error"],
        "mean_actions": shown["mean_actions"],
        "enclosed": shown["n_success_enclosed"],
        "commit": running_revision().commit,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("a") as file:
        file.write(json.dumps(row) + "\n")
    print(json.dumps(row), flush=True)


def read_rows(out: Path) -> list[dict[str, Any]]:
    """The lines of OUT."""
    return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []


def draw(rows: list[dict[str, Any]], picture: Path) -> None:
    """Draw the mean score against the CPU hours of training, a panel a task."""
    tasks = [task for task in TASKS if any(row["task"] == task for row in rows)]
    figure = Figure(figsize=(3.2 * len(tasks), 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
    for panel, task in zip(panels, tasks, strict=True):
        for network, colour in (("original", "0.45"), ("fast", "tab:blue")):
            points = sorted(
                (row["training_cpu_s"] / 3600, row["score"], 1.96 * row["score_error"])
                for row in rows
                if (row["task"], row["network"]) == (task, network)
            )
            if points:
                hours, score, error = zip(*points, strict=True)
                panel.errorbar(hours, score, error, color=colour, marker="o", ms=3, label=network)
        panel.set(title=task, xscale="log", xlabel="CPU hours of training", ylim=(0, 1))
    panels[0].set_ylabel("mean score of test episodes")
    panels[0].legend(frameon=False)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main()
