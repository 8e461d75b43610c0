"""The verb `refine` of the `warp-deform` command."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.cli import CommandOptions, Outcome
from warp_deform.quiet import quiet_warp

__all__ = ["RefineOptions", "refine"]


@dataclass(frozen=True, kw_only=True)
class RefineOptions(CommandOptions):
    """Improve recorded demonstrations by search; the same command goes on where it was stopped."""

    source: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of demonstrations; it stays as it is."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the refined ones, and for copies of those that did not become better."""
    method: Literal["enumerate", "random", "cem", "gradient"] = "cem"
    """How to search beyond the task's candidates: not at all, by draws, by draws ever closer to the
    best (the cross-entropy method), or down the slope of the task's loss."""
    depth: Literal[1, 2] = 2
    """Actions to look ahead."""
    budget: Annotated[int, arg(metavar="N")] = 64
    """Simulated actions that the search for one action may spend."""
    workers: Annotated[int | None, arg(metavar="W")] = None
    """Processes; left out, one per core. The result is the same."""


def refine(options: RefineOptions) -> Outcome:
    """Refine a folder of demonstrations."""
    from warp_deform.planning import SearchConfig

    from .refinement import RefineConfig
    from .refinement import refine as refine_folder

    quiet_warp()
    report = refine_folder(
        RefineConfig(
            source=options.source,
            out=options.out,
            search=SearchConfig(method=options.method, depth=options.depth, budget=options.budget),
            workers=options.workers,
        )
    )
    text = (
        f"{options.out}: {report.improved} of {report.episodes} episodes improved, actions "
        f"{report.actions_before} -> {report.actions_after}, mean score {report.score_before:.3f} "
        f"-> {report.score_after:.3f}, in {report.seconds:.1f} s"
    )
    return Outcome(data=asdict(report), text=text)
