"""How long and in which steps to train: the paper's schedules, and ours for two CPU cores.

Source: Seita et al., ICRA 2021, appendix on training.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from warp_deform.errors import InputError

__all__ = ["SCHEDULES", "STATE_SCHEDULES", "TRACED_SCHEDULE", "Schedule", "preset_schedule"]


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long and in which steps to train."""

    steps: int
    """Steps of the optimiser, which the original calls iterations."""
    batch: int
    """Transitions a step and process."""
    lr: float
    """Greatest step size of Adam."""
    place_lr: float = 1.0
    """Step size of the 2-Step baseline's place network, over that of the others."""
    even: float = 0.0
    """Share of the steps in which the Gaussians of a baseline's mixture all weigh the same,
    whatever they weighed before; their weights are learnt from there on."""
    warmup: int = 0
    """Steps over which the step size grows from 0."""
    decay: bool = False
    """Let the step size fall to 0 like a cosine."""
    ema: float = 0.0
    """Snapshots hold weights averaged over 1 / (1 - ema) steps or so; 0: weights as they are."""
    mirror: bool = False
    """Learn from mirror images, too, where the task has them."""
    snapshots: int = 10
    """Snapshots, the last one at the end."""
    shares: tuple[float, ...] = ()
    """Where not empty, a snapshot comes after each of these shares of the steps (so there are fewer
    where the first ones would fall together), in place of evenly spread ones."""
    validate: int = 0
    """Validation episodes that every snapshot plays; training ends when one solves them all, and
    `confirm` further ones."""
    confirm: int = 0
    """Validation episodes that a snapshot plays once it solved all that every snapshot plays. Of
    agents that solve 92 %, every fifth would end its training after 20 episodes, and one in 150
    after 60."""
    patience: int | None = None
    """Training also ends after so many snapshots in a row that brought nothing."""

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("batch", 1), ("snapshots", 1), ("warmup", 0),
                            ("validate", 0), ("confirm", 0)):  # fmt: skip
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be {least} or more")
        if self.shares and not (0 < min(self.shares) and max(self.shares) == 1.0):
            raise InputError(f"shares are {self.shares}; they must be above 0, and the greatest 1")
        if self.snapshots > self.steps and not self.shares:
            raise InputError(
                f"snapshots is {self.snapshots}; with steps = {self.steps} it must be 1 to "
                f"{self.steps}"
            )
        if not 0 < self.lr < math.inf:
            raise InputError(f"lr is {self.lr}; it must be a positive number")
        if not 0 < self.place_lr < math.inf:
            raise InputError(f"place_lr is {self.place_lr}; it must be a positive number")
        if not 0 <= self.even <= 1:
            raise InputError(f"even is {self.even}; it must be from 0 to 1")
        if not 0 <= self.ema < 1:
            raise InputError(f"ema is {self.ema}; it must be 0 or more and less than 1")

    def snapshot_steps(self) -> tuple[int, ...]:
        """Steps after which a snapshot is kept.

        Examples:
            >>> Schedule(steps=10, batch=1, lr=1.0, snapshots=4).snapshot_steps()
            (2, 5, 8, 10)
            >>> Schedule(steps=4000, batch=1, lr=1.0, shares=(0.075, 0.3, 1.0)).snapshot_steps()
            (300, 1200, 4000)
        """
        n = self.snapshots
        if self.shares:
            steps = (round(share * self.steps) for share in self.shares)
            return tuple(sorted({step for step in steps if step}))
        return tuple(round(k * self.steps / n) for k in range(1, n + 1))

    def lr_at(self, step: int) -> float:
        """Step size at a step, counted from 1."""
        grown = min(1.0, step / self.warmup) if self.warmup else 1.0
        fallen = 0.5 * (1 + math.cos(math.pi * (step - 1) / self.steps)) if self.decay else 1.0
        return self.lr * grown * fallen

    def kept_at(self, step: int) -> float:
        """How much of the average of the weights is kept at a step.

        It is less at first, so that the initial weights are forgotten.
        """
        return min(self.ema, step / (step + 10.0)) if self.ema else 0.0


SCHEDULES = {
    "paper": Schedule(steps=20_000, batch=1, lr=1e-4),
    "fast": Schedule(
        steps=4000,
        batch=1,
        lr=1e-3,
        warmup=100,
        decay=True,
        ema=0.998,
        mirror=True,
        snapshots=5,
        shares=(0.075, 0.15, 0.3, 0.6, 1.0),
        validate=20,
        confirm=40,
        patience=2,
    ),
}
"""By the names of the command line, for agents over pictures."""
STATE_SCHEDULES = {
    "paper": Schedule(steps=20_000, batch=128, lr=2e-4),
    # The paper's steps and their size: a tenth of them leaves the block unlearnt, and five times
    # the size has mixtures of cables collapse to one Gaussian. Where to place what was picked is
    # nearly certain and hard to learn: on the block longer steps bring it far more. On cables
    # more Gaussians stay in use where they weigh the same at first (docs/baselines.md).
    "fast": Schedule(
        steps=20_000,
        batch=128,
        lr=2e-4,
        place_lr=5.0,
        even=0.5,
        decay=True,
        ema=0.99,
        snapshots=4,
        validate=20,
        confirm=40,
    ),
}
"""The same for the ground-truth baselines."""

TRACED_SCHEDULE = Schedule(
    steps=4000,
    batch=64,
    lr=2e-3,
    warmup=100,
    decay=True,
    ema=0.99,
    snapshots=3,
    validate=20,
    confirm=40,
)
"""Of agents that trace the cable, for the preset `fast`; the paper has none."""

_LONGER = Schedule(steps=40_000, batch=1, lr=1e-4)
_LONGER_TASK, _LONGER_FROM = "bag-color-goal", 100


def preset_schedule(
    preset: str, *, task: str, demos: int, sees: Literal["pictures", "traces", "state"]
) -> Schedule:
    """A preset's schedule for a task, a number of demonstrations, and what an agent sees.

    The paper's agents over pictures train for twice as long on bag-color-goal with 100
    demonstrations or more.
    """
    if sees == "state":
        return STATE_SCHEDULES[preset]
    if sees == "traces":
        return TRACED_SCHEDULE
    if preset == "paper" and task == _LONGER_TASK and demos >= _LONGER_FROM:
        return _LONGER
    return SCHEDULES[preset]
