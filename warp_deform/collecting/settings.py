"""What to collect, each setting once: fields of a configuration, flags, and their help.

`collect.CollectConfig` checks them and `warp-deform demo` takes them as flags. Importing this is
quick: it loads no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from ..robots import RobotName
from ..support.flag_range import COUNT, SEED

__all__ = ["CollectSettings", "DemonstratorName"]

DemonstratorName = Literal["scripted", "visible", "mpc", "planner"]


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """What to collect, and how."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task, see `warp-deform list`."""
    episodes: Annotated[int, arg(aliases=["-n"], metavar="N"), COUNT] = 10
    """Successes to keep: the first N in the order of their seeds."""
    seed: Annotated[int, SEED] = 0
    """First seed. Training 0.., test 10,000.., validation 50,000.., goals 100,000.. ."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the episodes; complete ones that are there already are kept."""
    demonstrator: DemonstratorName = "scripted"
    """Who acts: "scripted", the paper's; "visible", which picks only what the tip would really
    meet; "mpc", which simulates eight candidates and takes the best; "planner", which searches two
    actions ahead. All see the state."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Processes; left out, one per core, fewer for few episodes. The result is the same."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Address of a Ray cluster to work on that shares the folder (needs the extra `ray`)."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """MP4 of the first two kept episodes."""
    robot: RobotName = "ur5"
    """The arm."""
