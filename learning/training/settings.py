"""What to train and how, each setting once: fields of a configuration, flags, and their help.

`config.TrainConfig` checks them, `warp-deform train` takes them as flags and a sweep's file as
keys. Importing this is quick: it loads no torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.support.flag_range import COUNT, COUNT_OR_NONE, SEED, FlagRange

__all__ = ["AgentName", "PresetName", "TrainMethod", "TrainSettings"]

AgentName = Literal["transporter", "goal-split", "goal-stack", "gt-mlp", "gt-mlp-2step"]
PresetName = Literal["paper", "fast"]


@dataclass(frozen=True, kw_only=True)
class _Trained:
    """What is trained, from what, and where it is kept."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task, see `warp-deform list`."""
    agent: AgentName
    """Transporters see pictures (goal-split and goal-stack the goal's too), the others see the
    simulator's state."""
    data: Annotated[Path, arg(metavar="DIR")]
    """Folder of demonstrations, see `warp-deform demo`."""
    demos: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Demonstrations to learn from, drawn by --seed; when left out, all that are not held out."""
    seed: Annotated[int, SEED] = 0
    """Of the initial weights, of what is drawn, and of which demonstrations are used."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the run."""


@dataclass(frozen=True, kw_only=True)
class TrainMethod:
    """How to train: what the runs of a sweep have in common."""

    preset: PresetName = "paper"
    """The paper's network and schedule, or one for two CPU cores."""
    steps: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Steps of training; the preset's when left out."""
    batch: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Moments a step; the preset's when left out."""
    lr: Annotated[float | None, arg(metavar="LR"), FlagRange(1e-12, 1e3)] = None
    """Step size of Adam; the preset's when left out."""
    snapshots: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Snapshots, evenly spread; when left out, the preset's: of `paper` 10, of `fast` after 1/16,
    1/8, 1/4, 1/2 and all of the steps."""
    validate: Annotated[int | None, arg(metavar="N"), COUNT_OR_NONE] = None
    """Validation episodes that every snapshot plays; training ends when one solves them all, and
    `eval` does not play them again. When left out, the preset's: 20 of `fast` (0 with --hold-out),
    0 of `paper`."""
    patience: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Also stop when so many snapshots in a row played no better; needs validation."""
    bf16: bool = False
    """Convolve in bfloat16: quicker where the processor multiplies it natively."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network computes; under `torchrun`, each process takes one GPU."""
    untrained: bool = False
    """Also keep the untrained network, as the snapshot of step 0: learning curves begin there."""


@dataclass(frozen=True, kw_only=True)
class TrainSettings(TrainMethod, _Trained):
    """What to train, and how."""

    exact: bool = False
    """Compute by the original's operations, several times slower; see docs/learning.md."""
    hold_out: Annotated[int, arg(metavar="N"), COUNT_OR_NONE] = 0
    """Further demonstrations, not learnt from: the snapshot of the lowest loss on them is taken."""
    threads: Annotated[int, arg(metavar="N"), FlagRange(1, 4096)] = 1
    """Threads of torch, in each process; another number may change the last bits."""
    tensorboard: bool = False
    """Write for TensorBoard too, which has to be installed."""
