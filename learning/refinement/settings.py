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

__all__ = ["FolderSettings", "RefineSettings"]


@dataclass(frozen=True, kw_only=True)
class FolderSettings:
    """From which folder into which, in how many processes."""

    source: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of demonstrations, simulated ones, of any tasks; it stays as it is."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the refined ones, and for copies of those that did not become better."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Processes; left out, one per core. The result is the same."""


@dataclass(frozen=True, kw_only=True)
class RefineSettings(FolderSettings):
    """What to refine, and when it counts as better."""

    accept: Literal["score", "solved"] = "score"
    """When an episode takes the place of the original: if it has no lower last score and no more
    actions, or if it solves the task in fewer actions or in as many with a higher score."""
