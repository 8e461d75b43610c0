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

__all__ = ["CollectSettings", "DemonstratorName", "TipMode"]

DemonstratorName = Literal["scripted", "visible", "mpc", "planner"]
TipMode = Literal["tip_delta_position", "tip_delta_pose"]


@dataclass(frozen=True, kw_only=True)
class CollectSettings:
    """What to collect, and how."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task; `warp-deform list` shows all. Those for control need `--control`."""
    episodes: Annotated[int, arg(aliases=["-n"], metavar="N"), COUNT] = 10
    """How many successes to keep: the first N in the order of their seeds."""
    seed: Annotated[int, SEED] = 0
    """First seed. Training has seeds from 0, test from 10,000, validation from 50,000, and goals
    from 100,000 on."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the episodes. If it holds some already, the collection goes on from there."""
    demonstrator: DemonstratorName = "scripted"
    """Who acts. "scripted" is the paper's demonstrator. "visible" picks only what the tip would
    really meet. "mpc" simulates eight candidates and takes the best. "planner" searches two actions
    ahead. All of them see the simulator's state."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Number of processes; by default one per core, and fewer for few episodes. The result does not
    depend on it."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Address of a Ray cluster to work on. It has to share the folder (needs the extra `ray`)."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """Film the first two kept episodes into this MP4."""
    robot: RobotName = "ur5"
    """Which arm moves."""
    goals: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of goals, see `warp-deform goals`. The seed decides which one an episode goes for, and
    its start is drawn for it, as a test's is. By default every seed makes a goal of its own. To
    train on, take goals of seeds from 200,000 on."""
    control: bool = False
    """Demonstrate control at 20 Hz: the tip is led step by step, in the environment
    `WarpDeform/<Task>-Control-v1`. Swings (whip, whip-target) are searched for."""
    control_mode: TipMode | None = None
    """With --control: what an action means. By default `tip_delta_pose` where the yaw of a place
    matters, else `tip_delta_position`."""
    start: Literal["free", "held"] = "free"
    """With --control: begin with a free tip, or with what would be moved first held."""
    horizon: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """With --control: steps after which an attempt is given up. By default the environment's, 200
    for tasks of the benchmark. Tasks of many picks need more."""
    pictures: bool = False
    """With --control: keep the picture from above of every step."""
    evaluations: Annotated[int, arg(metavar="N"), COUNT] = 1000
    """With --control: plans that a search for a swing simulates."""
