"""What computing the networks of a `fast` agent together saves, against network by network.

    python benchmarks/steps.py [--agents transporter goal-split] [--repeats 15] [--out FILE]

CPU time of one thread, batch 1, random pictures, medians. A step is losses, gradients, the
optimiser and the average of the weights; acting weighs up to five picks. "plain" computes network
by network (`Attention` and `Transport`), with torch's Adam and average tensor by tensor; "together"
is what `train` does. The kinds take turns in one run, so that other programs slow them alike, and
ratios are medians over turns. bfloat16 is measured where the processor has AMX, or with
--bfloat16.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from learning.models.batch import Batch
from learning.models.precision import has_bfloat16_tiles
from learning.models.transporter import PRESETS, GoalSplit, GoalStack, Transporter
from learning.runs.folder import RunFolder
from learning.training.schedules import SCHEDULES
from learning.training.state import Trained
from warp_deform.rendering.pixels import SHAPE

AGENTS = {agent.name: agent for agent in (Transporter, GoalSplit, GoalStack)}
Jobs = dict[str, Callable[[], object]]


class PlainAdam(torch.optim.Adam):
    """`KerasAdam` tensor by tensor."""

    steps = 0

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        self.steps += 1
        self.param_groups[0]["eps"] = 1e-7 / math.sqrt(1 - 0.999**self.steps)
        super().step(closure)


def jobs(name: str, kind: str, folder: Path) -> Jobs:
    """A step and an action of a kind: plain, together, or together in bfloat16."""
    agent = AGENTS[name](replace(PRESETS["fast"], bfloat16=kind == "bfloat16"), seed=0)
    parameters = list(agent.parameters())
    if kind == "plain":
        agent.pick_place = None
        optimizer = PlainAdam(parameters, lr=1e-3)
        averages = [each.detach().clone() for each in parameters]
    else:
        trained = Trained(agent, SCHEDULES["fast"], RunFolder(folder), "")
    rng, taken = np.random.default_rng(0), 0
    pictures = [
        (
            rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8),
            rng.uniform(0, 0.1, SHAPE).astype(np.float32),
        )
        for _ in range(agent.pictures)
    ]
    image, none = agent.image(*pictures)[None], torch.zeros(1, dtype=torch.int64)

    def step() -> None:
        nonlocal taken
        taken += 1
        pick, place = (
            torch.from_numpy(rng.integers(0, agent.config.shape, (1, 2))) for _ in range(2)
        )
        losses = agent(Batch(image, pick, place, torch.zeros(1), none))
        if kind != "plain":
            trained.step(taken, trained.gradient(losses.total()))
            return
        optimizer.zero_grad()
        losses.total().backward()
        optimizer.step()
        with torch.no_grad():
            for average, weight in zip(averages, parameters, strict=True):
                average.lerp_(weight, 0.002)

    return {"step": step, "act": lambda: agent.act(image)}


def seconds(job: Callable[[], object]) -> float:
    """CPU time of a call [s]."""
    start = time.process_time()
    job()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--agents", nargs="+", choices=AGENTS, default=["transporter", "goal-split"]
    )
    parser.add_argument("--repeats", type=int, default=15, help="turns that every kind takes")
    parser.add_argument("--bfloat16", action="store_true", help="measure it here all the same")
    parser.add_argument("--out", metavar="FILE", type=Path, help="rows as lines of JSON")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    kinds = ["plain", "together"]
    if arguments.bfloat16 or has_bfloat16_tiles():
        kinds.append("bfloat16")
    name_of_cpu = torch.cpu.get_capabilities().get("cpu_name", "unknown")
    print(f"{name_of_cpu}, AMX: {has_bfloat16_tiles()}")
    rows = []
    for agent in arguments.agents:
        with tempfile.TemporaryDirectory() as folder:
            made = {kind: jobs(agent, kind, Path(folder)) for kind in kinds}
            for what in ("step", "act"):
                for kind in kinds:
                    made[kind][what]()
                turns = np.array(
                    [[seconds(made[k][what]) for k in kinds] for _ in range(arguments.repeats)]
                )
                for kind, taken in zip(kinds, turns.T, strict=True):
                    ms, ratio = 1e3 * np.median(taken), np.median(turns[:, 0] / taken)
                    print(f"{agent:12} {what:5} {kind:9} {ms:7.1f} ms, plain / this {ratio:5.2f}")
                    about = {"cpu": name_of_cpu, "agent": agent, "what": what, "kind": kind}
                    rows.append({**about, "ms": float(ms), "ratio": float(ratio)})
    if arguments.out is not None:
        arguments.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    if arguments.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
