"""What to train, and how: the settings of a run, checked together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task

from ..models.transporter import Transporter, TransporterConfig
from ..policy.policy import AGENTS
from .processes import DEVICES
from .schedules import SCHEDULES, Schedule, preset_schedule

__all__ = ["TrainConfig"]


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What to train, and how.

    demos: demonstrations to learn from, drawn by `seed`; None takes all that `data` holds
    schedule: None takes the preset's; steps, batch, lr, snapshots: changes to it; snapshots whose
        number is given are evenly spread
    network: None takes the preset's; rotations and lifts are the task's in any case
    augment: turn and shift what is seen at random
    exact: compute by the original's operations, several times slower
    bf16: convolve in bfloat16, agents over pictures alone
    threads: of torch, a process; another number may change the last bits
    hold_out: further demonstrations, not learnt from, on which every snapshot's loss is measured
    validate: validation episodes that every snapshot plays: training ends when one solves them all,
        as nothing is left to be gained; 0 plays none. None takes the schedule's, but 0 with
        `hold_out`, which is for where nothing can be played
    patience: stop as well when so many snapshots in a row brought no better validation
    untrained: also a snapshot of the initial weights, step 0, where a learning curve begins
    progress: tell of it on stderr, see `warp_deform.support.progress`
    """

    task: str
    agent: str
    data: Path
    out: Path
    demos: int | None = None
    seed: int = 0
    preset: str = "paper"
    schedule: Schedule | None = None
    steps: int | None = None
    batch: int | None = None
    lr: float | None = None
    snapshots: int | None = None
    network: TransporterConfig | None = None
    augment: bool = True
    exact: bool = False
    bf16: bool = False
    device: str = "cpu"
    threads: int = 1
    hold_out: int = 0
    validate: int | None = None
    patience: int | None = None
    tensorboard: bool = False
    untrained: bool = False
    progress: bool = True

    def __post_init__(self) -> None:
        find_task(self.task)
        if self.agent not in AGENTS:
            raise InputError(f"there is no agent {self.agent!r}; there are: {', '.join(AGENTS)}")
        if self.preset not in SCHEDULES:
            raise InputError(f"preset is {self.preset!r}; it must be one of {sorted(SCHEDULES)}")
        if self.device not in DEVICES:
            raise InputError(f"device is {self.device!r}; it must be 'cpu' or 'cuda'")
        for name, least in (("seed", 0), ("threads", 1), ("hold_out", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be {least} or more")
        plan = self.plan(self.demos or 0)  # refuses changes that do not go together
        if self.patience is not None:
            if self.patience < 1:
                raise InputError(f"patience is {self.patience}; it must be 1 or more")
            if not plan.validate:
                raise InputError(
                    f"patience is {self.patience} and validate 0; stopping early needs validation "
                    "episodes, 1 or more"
                )
        for name in ("bf16", "network"):
            if getattr(self, name) and self._sees_state:
                raise InputError(f"{name} is for agents over pictures; {self.agent} has its own")
        if self.bf16 and self.exact:
            raise InputError("bf16 and exact exclude each other: the original computes in float32")

    def plan(self, demos: int) -> Schedule:
        """The schedule in force with so many demonstrations."""
        plan = self.schedule or preset_schedule(
            self.preset, task=self.task, demos=demos, sees_state=self._sees_state
        )
        changed = ("steps", "batch", "lr", "snapshots", "validate")
        wanted: dict[str, Any] = {
            name: getattr(self, name) for name in changed if getattr(self, name) is not None
        }
        if self.snapshots is not None:
            wanted["doubling"] = False
        if self.validate is None and self.hold_out:
            wanted["validate"] = 0
        return replace(plan, **wanted)

    @property
    def _sees_state(self) -> bool:
        return not issubclass(AGENTS[self.agent], Transporter)
