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

from ..data.goal_name import GoalName

__all__ = ["AgentName", "PrecisionName", "PresetName", "TrainMethod", "TrainSettings"]

AgentName = Literal["transporter", "goal-split", "goal-stack", "traced", "gt-mlp", "gt-mlp-2step"]
PresetName = Literal["paper", "fast"]
PrecisionName = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True, kw_only=True)
class _Trained:
    """What is trained, from what, and where it is kept."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task, see `warp-deform list`."""
    agent: AgentName
    """Transporters see pictures; goal-split and goal-stack also see the goal's picture. traced
    follows the cable in both masks of cable-mask-goal, learns what actions lead to, and needs
    --preset fast. The others see the simulator's state."""
    data: Annotated[Path, arg(metavar="DIR")]
    """Folder of demonstrations, see `warp-deform demo`."""
    demos: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Number of demonstrations to learn from, drawn by --seed. By default, all not held out."""
    seed: Annotated[int, SEED] = 0
    """Seed of the initial weights, of the random draws, and of the choice of demonstrations."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder of the run."""


@dataclass(frozen=True, kw_only=True)
class TrainMethod:
    """How to train: what the runs of a sweep have in common."""

    preset: PresetName = "paper"
    """The paper's network and schedule, or one for two CPU cores."""
    goal: GoalName = "end"
    """What is the goal of a demonstration: its end, as in the paper, or the goal of its own that it
    was recorded with, which other objects can surround; see `demo --goals`. traced learns of no
    goal."""
    steps: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Number of training steps. By default, the preset's."""
    batch: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Transitions per step. By default, the preset's."""
    lr: Annotated[float | None, arg(metavar="LR"), FlagRange(1e-12, 1e3)] = None
    """Learning rate of Adam. By default, the preset's."""
    snapshots: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """Number of snapshots, evenly spread. By default, `paper` keeps 10, and `fast` keeps one after
    7.5, 15, 30, 60 and 100 % of the steps (4 of agents that see the state and 3 of traced)."""
    validate: Annotated[int | None, arg(metavar="N"), COUNT_OR_NONE] = None
    """Validation episodes that every snapshot plays. Training ends when a snapshot solves them all
    and those of --confirm, and `eval` does not play them again. By default, 20 for `fast` (0 with
    --hold-out) and 0 for `paper`."""
    confirm: Annotated[int | None, arg(metavar="N"), COUNT_OR_NONE] = None
    """Further validation episodes for a snapshot that solved all of --validate: only one that
    solves these too ends training. By default, 40 for `fast` and 0 for `paper`."""
    patience: Annotated[int | None, arg(metavar="N"), COUNT_OR_NONE] = None
    """Also stop after this many snapshots in a row that brought nothing; 0: never. This needs
    validation. By default, 2 for `fast` agents over pictures, and 0 for others."""
    precision: PrecisionName = "auto"
    """Number format of the convolutions in agents that see pictures. `auto` takes bfloat16 for
    `fast` on a processor with AMX, and float32 otherwise."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the network computes. Under `torchrun`, each process takes one GPU."""
    untrained: bool = False
    """Also keep the untrained network as the snapshot of step 0, where learning curves begin."""


@dataclass(frozen=True, kw_only=True)
class TrainSettings(TrainMethod, _Trained):
    """What to train, and how."""

    exact: bool = False
    """Use the original's operations, which are several times slower; see docs/learning.md."""
    start: Annotated[Path | None, arg(metavar="RUN")] = None
    """Begin with the weights of this run, those that `eval` chose or the last ones, instead of
    random ones. Its agent must be the same."""
    hold_out: Annotated[int, arg(metavar="N"), COUNT_OR_NONE] = 0
    """Number of further demonstrations that are not learnt from. The snapshot with the lowest loss
    on them is used until `eval` chooses one."""
    threads: Annotated[int, arg(metavar="N"), FlagRange(1, 4096)] = 1
    """Threads of torch in each process. Another number may change the last bits."""
    tensorboard: bool = False
    """Also write logs for TensorBoard, which must be installed."""
