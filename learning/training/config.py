"""What to train, and how: the settings of a run, checked together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args

from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task

from ..data.goal_name import GoalName
from ..models.transporter import TransporterConfig
from ..policy.policy import AGENTS
from .processes import DEVICES
from .schedules import SCHEDULES, Schedule, preset_schedule
from .settings import PrecisionName, TrainSettings

__all__ = ["TrainConfig"]

GOALS, PRECISIONS = get_args(GoalName), get_args(PrecisionName)


@dataclass(frozen=True, kw_only=True)
class TrainConfig(TrainSettings):
    """The settings of a run, checked, and what a program alone can choose."""

    augment: bool = True
    """Turn, shift and mirror what is seen at random, as the paper does (but for mirrors)."""
    schedule: Schedule | None = None
    """In place of the preset's; steps, batch, lr, snapshots and validate change it."""
    network: TransporterConfig | None = None
    """In place of the preset's; rotations and lifts are the task's in any case."""
    progress: bool = True
    """Show progress on stderr, see `warp_deform.support.progress`."""

    def __post_init__(self) -> None:
        find_task(self.task)
        if self.agent not in AGENTS:
            raise InputError(f"there is no agent {self.agent!r}; there are: {', '.join(AGENTS)}")
        if self.preset not in SCHEDULES:
            raise InputError(f"preset is {self.preset!r}; it must be one of {sorted(SCHEDULES)}")
        if self.goal not in GOALS:
            raise InputError(f"goal is {self.goal!r}; it must be one of {list(GOALS)}")
        if self.goal == "own" and not find_task(self.task).goal_conditioned:
            raise InputError(f"goal is 'own', and {self.task} has no goals; leave --goal out")
        if self.goal == "own" and AGENTS[self.agent].sees == "traces":
            raise InputError(
                f"goal is 'own', and {self.agent} learns what actions lead to, whatever the goal; "
                "leave --goal out"
            )
        if self.device not in DEVICES:
            raise InputError(f"device is {self.device!r}; it must be 'cpu' or 'cuda'")
        for name, least in (("seed", 0), ("threads", 1), ("hold_out", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be {least} or more")
        plan = self.plan(self.demos or 0)  # refuses changes that do not go together
        if self.patience is not None and self.patience < 0:
            raise InputError(f"patience is {self.patience}; it must be 0 or more")
        if self.patience and not plan.validate:
            raise InputError(
                f"patience is {self.patience} and validate 0; stopping early needs validation "
                "episodes, 1 or more"
            )
        if self.confirm and not plan.validate:
            raise InputError(
                f"confirm is {self.confirm} and validate 0; there is nothing to confirm without "
                "validation episodes"
            )
        if self.precision not in PRECISIONS:
            raise InputError(
                f"precision is {self.precision!r}; it must be one of {list(PRECISIONS)}"
            )
        for name, given in (("precision", self.precision != "auto"), ("network", self.network)):
            if given and AGENTS[self.agent].sees != "pictures":
                raise InputError(f"{name} is for agents over pictures; {self.agent} has its own")
        if AGENTS[self.agent].sees == "traces" and self.preset != "fast":
            raise InputError(
                f"preset {self.preset} has no agent that traces cables; use --preset fast"
            )
        if self.exact and AGENTS[self.agent].sees == "traces":
            raise InputError(f"exact: the original has no {self.agent} agent; leave --exact out")
        if self.precision == "bfloat16" and self.exact:
            raise InputError(
                "precision bfloat16 and exact exclude each other: the original computes in float32"
            )

    def plan(self, demos: int) -> Schedule:
        """The schedule in force with so many demonstrations."""
        plan = self.schedule or preset_schedule(
            self.preset, task=self.task, demos=demos, sees=AGENTS[self.agent].sees
        )
        if self.schedule is None and (self.exact or self.start is not None):
            plan = replace(plan, even=0.0)  # as in the original, and what was learnt is kept
        changed = ("steps", "batch", "lr", "snapshots", "validate", "confirm")
        wanted: dict[str, Any] = {
            name: getattr(self, name) for name in changed if getattr(self, name) is not None
        }
        if self.snapshots is not None:
            wanted["shares"] = ()
        if self.validate is None and self.hold_out:
            wanted["validate"] = 0
        plan = replace(plan, **wanted)
        if not plan.validate:
            plan = replace(plan, confirm=0)
        patience = plan.patience if self.patience is None else self.patience
        return replace(plan, patience=(patience or None) if plan.validate else None)
