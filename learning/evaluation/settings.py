"""How runs are evaluated, each setting once: flags of `warp-deform eval`, keys of a sweep's file.

Importing this is quick: it loads no torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from warp_deform.robots import RobotName
from warp_deform.support.flag_range import COUNT

__all__ = ["EvalSettings"]


@dataclass(frozen=True, kw_only=True)
class EvalSettings:
    """How a run is evaluated; see `run.evaluate_run`."""

    episodes: Annotated[int, arg(metavar="N"), COUNT] = 200
    """Number of test episodes."""
    validation_episodes: Annotated[int, arg(metavar="N"), COUNT] = 20
    """Number of validation episodes per snapshot, with seeds 50,000 and up."""
    paper: bool = False
    """Also use the paper's protocol: every snapshot plays 20 test episodes with demonstrated goals,
    and the best result counts. This is optimistic."""
    stage_rule: Literal["action", "privileged"] = "action"
    """What chooses the lift: the policy, or the paper's rule, which reads the simulator."""
    robot: RobotName = "ur5"
    """The arm."""
