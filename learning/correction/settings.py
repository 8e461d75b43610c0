"""What to correct, each setting once: fields of a configuration, flags, and their help.

`correct.CorrectConfig` checks them and `warp-deform correct` takes them as flags. Importing this is
quick: it loads no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from warp_deform.collecting.settings import DemonstratorName
from warp_deform.robots import RobotName
from warp_deform.support.flag_range import COUNT, SEED

__all__ = ["CorrectSettings"]


@dataclass(frozen=True, kw_only=True)
class CorrectSettings:
    """Whose policy to correct, by whom, and how often."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a training run that has come to its end. The snapshot that `eval` chose acts, or
    the last one."""
    teacher: DemonstratorName
    """Who says in every state what it would have done; see `demo --demonstrator`."""
    episodes: Annotated[int, arg(aliases=["-n"], metavar="N"), COUNT] = 20
    """Number of episodes that the policy plays."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the corrected episodes, and for copies of all that RUN learned from."""
    data: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder that holds what RUN learned from. By default, the one that RUN names."""
    seed: Annotated[int | None, SEED] = None
    """First seed. By default, the one after the greatest that RUN learned from."""
    goals: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of goals, see `warp-deform goals`; none may be of tests. The seed decides which one an
    episode goes for, as in `demo --goals`. By default every seed makes a goal of its own.
    bag-color-goal needs a folder, as such a goal would show what those of tests do not."""
    robot: RobotName = "ur5"
    """Which arm moves."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Number of processes, by default one per core, and fewer for few episodes. It does not change
    the result."""
