"""CPU time of a training step and of acting, against the original's in TensorFlow.

    python benchmarks/models.py [--tensorflow PYTHON] [--json]

One thread, batch 1, process CPU time, median: a step is attention, transport and lift forward,
their gradients and Adam. With --tensorflow, an interpreter that has TensorFlow, the same agent of
the original (tensorflow_peer.py) takes its steps in the same run, before ours and after them: a
machine's speed drifts. Without it ratios are to 16.1 CPU s, a step of the original's Transporter
with TensorFlow 2.14 and all threads, measured once on a machine of the same kind while others used
it. Rotations are 24 where nothing else is said, 1 in TensorFlow and `fast`. The paper's size takes
minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from learning.models.adam import KerasAdam
from learning.models.transporter import (
    PRESETS,
    Batch,
    GoalSplit,
    GoalStack,
    Transporter,
    TransporterConfig,
)

TENSORFLOW_STEP = 16.1
"""CPU time of the original's training step [s]."""
PEER = Path(__file__).with_name("tensorflow_peer.py")
AGENTS = {agent.name: agent for agent in (Transporter, GoalSplit, GoalStack)}


def configurations() -> dict[str, TransporterConfig]:
    """The presets in both precisions, and what changes their cost most."""
    fast, paper = PRESETS["fast"], PRESETS["paper"]
    return {
        "fast": fast,
        "fast bfloat16": dataclasses.replace(fast, bfloat16=True),
        "fast 24 rotations": dataclasses.replace(fast, n_rotations_train=24, n_rotations_eval=24),
        "paper": paper,
        "paper bfloat16": dataclasses.replace(paper, bfloat16=True),
        "paper 1 rotation": dataclasses.replace(paper, n_rotations_train=1),
        "paper exact 1 rotation": dataclasses.replace(paper, n_rotations_train=1, exact=True),
    }


def median(job: Callable[[], object], repeats: int) -> float:
    """Median CPU time of `job` [s], after one call that prepares kernels."""
    job()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        job()
        times.append(time.process_time() - start)
    return float(np.median(times))


def measure(agent_name: str, config: TransporterConfig, repeats: int) -> dict[str, float]:
    """CPU time of a step and of acting on random pictures, with random labels."""
    agent = AGENTS[agent_name](dataclasses.replace(config, lifts=(0.05, 0.3)), seed=0)
    optimiser = KerasAdam(agent.parameters())
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (320, 160, 3), dtype=np.uint8)
    height = rng.uniform(0, 0.1, (320, 160)).astype(np.float32)
    pictures = [(color, height)] * agent.pictures
    image = agent.image(*pictures)[None]

    def pixel() -> torch.Tensor:
        return torch.from_numpy(rng.integers(0, config.shape, (1, 2)))

    def step() -> None:
        theta = torch.from_numpy(rng.uniform(-np.pi, np.pi, 1))
        losses = agent(Batch(image, pixel(), pixel(), theta, torch.zeros(1, dtype=torch.int64)))
        optimiser.zero_grad()
        losses.total().backward()
        optimiser.step()

    trained = median(step, repeats)
    return {
        "step_s": trained,
        "act_s": median(lambda: agent.act(image), repeats),
        "steps_20000_h": 20_000 * trained / 3600,
    }


def tensorflow_steps(python: str, agent: str, steps: int) -> list[float]:
    """CPU times of steps of the original [s], measured now."""
    command = [python, str(PEER), "--agent", agent, "--steps", str(steps)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    seconds: list[float] = json.loads(done.stdout.splitlines()[-1])["step_s"]
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--agents", nargs="+", choices=AGENTS, default=["transporter", "goal-split"]
    )
    parser.add_argument(
        "--configurations", nargs="+", choices=configurations(), default=list(configurations())
    )
    parser.add_argument("--repeats", type=int, default=3, help="steps of every kind; fast: 5 times")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    parser.add_argument("--tensorflow", metavar="PYTHON", help="interpreter with TensorFlow")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = {}
    for agent in arguments.agents:
        python, peer = arguments.tensorflow, []
        if python:
            peer += tensorflow_steps(python, agent, arguments.repeats)
        of_agent = {}
        for name in arguments.configurations:
            config = configurations()[name]
            repeats = arguments.repeats * (5 if config.scale > 1 else 1)
            row = of_agent[name] = rows[f"{agent}, {name}"] = measure(agent, config, repeats)
            print(
                f"{agent:12} {name:24} step {row['step_s']:6.3f} s   act {row['act_s']:6.3f} s   "
                f"20,000 steps {row['steps_20000_h']:5.1f} h",
                flush=True,
            )
        if python:
            peer += tensorflow_steps(python, agent, arguments.repeats)
            print(
                f"{agent:12} {'TensorFlow':24} step {np.median(peer):6.3f} s, "
                f"{min(peer):.3f} to {max(peer):.3f}"
            )
        for name, row in of_agent.items():
            row["tensorflow_step_s"] = float(np.median(peer)) if peer else TENSORFLOW_STEP
            row["tensorflow_ratio"] = row["tensorflow_step_s"] / row["step_s"]
            print(f"{agent:12} {name:24} TensorFlow / this {row['tensorflow_ratio']:5.1f}")
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
