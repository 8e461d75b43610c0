"""The verb `convert` of the `warp-deform` command."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError
from warp_deform.support.flag_range import COUNT

__all__ = ["ConvertOptions", "convert"]


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(CommandOptions):
    """Convert a dataset to or from another format. The destination appears when it is whole."""

    source: Annotated[Positional[Path], arg(metavar="SRC")]
    """Folder of episodes. With --from it is a folder of the original code for one task, which holds
    `color`, `depth`, `action` and so on."""
    target: Annotated[Positional[Path], arg(metavar="DST")]
    """Where to write: a folder, or with `--to robomimic` a file that ends with .hdf5."""
    to: Literal["lerobot", "robomimic"] | None = None
    """Format to write: a LeRobotDataset v3.0, or robomimic's HDF5 (needs the extra `export`)."""
    origin: Annotated[Literal["deformable-ravens"] | None, arg(name="from")] = None
    """Format to read: the pickles of the original code. A process reads them that can run none of
    their code."""
    task: Annotated[str | None, arg(metavar="TASK")] = None
    """With --from: the name of the task here. By default the folder's name tells it."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """With --from: number of processes; by default one per core, and fewer for few episodes."""


def convert(options: ConvertOptions) -> Outcome:
    """Convert a dataset."""
    if (options.to is None) == (options.origin is None):
        raise InputError("give either --to lerobot or robomimic, or --from deformable-ravens")
    if options.to is not None and (options.task, options.workers) != (None, None):
        raise InputError("--task and --workers go with --from")
    if options.to == "lerobot":
        from ..interchange.lerobot import export_lerobot

        report = export_lerobot(options.source, options.target)
    elif options.to == "robomimic":
        from ..interchange.robomimic import export_robomimic

        report = export_robomimic(options.source, options.target)
    else:
        from ..interchange.deformable_ravens import import_deformable_ravens

        report = import_deformable_ravens(
            options.source, options.target, task=options.task, workers=options.workers
        )
    text = (
        f"{report.out}: {report.episodes} episodes, {report.steps} steps of {report.task}, "
        f"{report.bytes / 1e6:.1f} MB in {report.seconds:.1f} s"
    )
    return Outcome(data=asdict(report), text=text)
