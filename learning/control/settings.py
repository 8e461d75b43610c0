"""How to train a policy of control by gradients, each setting once: fields, flags, and their help.

`train.ControlTrainConfig` checks them and `warp-deform train-control` takes them as flags.
Importing this is quick: it loads no torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.support.flag_range import COUNT, SEED, FlagRange

__all__ = ["ControlTrainSettings", "GradientMethod"]

GradientMethod = Literal["apg", "shac", "plan"]


@dataclass(frozen=True, kw_only=True)
class ControlTrainSettings:
    """What to train, how, and how long."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of a task that a suction tip plays, or of one that is made for control, as whip-target.
    What would be moved first is held from the start."""
    method: GradientMethod = "apg"
    """Gradients of whole episodes (apg), or of short horizons with a critic (shac), or of plans: a
    network that plans a whole swing from its first observation (plan)."""
    minutes: Annotated[float, arg(metavar="M"), FlagRange(0.01, 1e5)] = 5.0
    """CPU minutes for the updates, planned from the costs that are measured at the beginning.
    Validation is not covered."""
    updates: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Number of updates, in place of --minutes."""
    worlds: Annotated[int, arg(metavar="N"), FlagRange(1, 4096)] = 32
    """Episodes of an update, side by side."""
    episodes: Annotated[int | None, arg(metavar="N"), FlagRange(1, 10_000)] = None
    """Seeds from 0 on among which an update draws its episodes; not fewer than --worlds. By
    default, 512, and 2048 for plan."""
    horizon: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Control steps of an episode. By default, the task's; 200 for tasks of the benchmark."""
    lr: Annotated[float | None, arg(metavar="LR"), FlagRange(1e-12, 1e3)] = None
    """Learning rate of Adam at first; it falls linearly to 0. By default, the method's."""
    snapshots: Annotated[int, arg(metavar="N"), COUNT] = 5
    """Number of snapshots, evenly spread."""
    validate: Annotated[int, arg(metavar="N"), FlagRange(1, 50_000)] = 64
    """Validation episodes that every snapshot plays, with seeds 50,000 and up. The best snapshot is
    used."""
    seed: Annotated[int, SEED] = 0
    """Seed of the initial weights, and of the draws of episodes and of noise."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the run."""
