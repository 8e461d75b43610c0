"""What to refine, each setting once: fields of a configuration, flags, and their help.

`refine.RefineConfig` checks them and `warp-deform refine` takes them as flags. Importing this is
quick: it loads no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.support.flag_range import COUNT

__all__ = ["FolderSettings", "RefineSettings", "TrajectorySettings"]


@dataclass(frozen=True, kw_only=True)
class FolderSettings:
    """From which folder into which, in how many processes."""

    source: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of simulated demonstrations, of any tasks. It is not changed."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the refined demonstrations, and for copies of those that did not improve."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Number of processes, by default one per core. It does not change the result."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings(FolderSettings):
    """What to refine, and when it counts as better."""

    accept: Literal["score", "solved"] = "score"
    """When an episode replaces the original. score: it has no lower last score and no more actions.
    solved: it solves the task in fewer actions, or in as many with a higher score."""


@dataclass(frozen=True, kw_only=True)
class TrajectorySettings(FolderSettings):
    """Which trajectories to refine, and how."""

    method: Literal["cem", "cmaes", "random", "adam", "lbfgs", "cem+adam"] = "cem"
    evaluations: int = 250
    """Simulated episodes that the search for one may spend; one with derivatives counts 2.5."""
    horizon: int | None = None
    """Control steps after which a replay of picks and places at 20 Hz is given up; None: as the
    environment."""
