"""What to distill, each setting once: fields of a configuration, flags, and their help.

`distill.DistillConfig` checks them and `warp-deform distill` takes them as flags. Importing this is
quick: it loads no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.collecting.settings import DemonstratorName
from warp_deform.support.flag_range import COUNT, SEED, FlagRange

__all__ = ["DistillSettings"]


@dataclass(frozen=True, kw_only=True)
class DistillSettings:
    """Which task, by whom, and how much it may cost."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task, see `warp-deform list`."""
    minutes: Annotated[float, arg(metavar="M"), FlagRange(0.1, 1e5)] = 60.0
    """CPU minutes for all but the test, planned from the costs measured at the beginning."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for everything. The policy is the run in DIR/run."""
    agent: Literal["auto", "transporter", "goal-split", "goal-stack"] = "auto"
    """By default transporter, and goal-split for tasks with a goal image."""
    teacher: DemonstratorName = "mpc"
    """Who demonstrates and corrects; see `demo --demonstrator`."""
    refine: Literal["auto", "always", "never"] = "auto"
    """Refine demonstrations by search before the first training. By default, if the teacher is
    scripted."""
    seed: Annotated[int, SEED] = 0
    """Seed of the weights and of all draws in training."""
    episodes: Annotated[int, arg(metavar="N"), COUNT] = 200
    """Number of test episodes, which the budget does not cover."""
    plan: Annotated[Path | None, arg(metavar="FILE")] = None
    """A distill.json whose plan is followed, in place of one for --minutes."""
