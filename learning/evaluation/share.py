"""Export of a trained policy: the chosen snapshot alone, rounded to half its bytes."""

from __future__ import annotations

from pathlib import Path

import torch

from ..interchange.conversion import new_folder
from ..runs.folder import RunFolder, read_snapshot, write_json
from .snapshot import trained_steps

__all__ = ["share_run"]


def share_run(path: Path, out: Path) -> Path:
    """Write the snapshot that `eval` chose into a folder of its own; returns the weights' path.

    Weights are rounded to bfloat16 and read back as float32, so results may differ from the run's
    in a few episodes: `warp-deform eval` tests the folder like any run's. Training does not go on
    from it.

    Raises:
        InputError: there is no snapshot, `out` exists, or a file is damaged.
    """
    run = RunFolder(path)
    settings, file = run.read_settings(), run.chosen_snapshot()
    weights, record = read_snapshot(file)
    rounded = {name: each.to(torch.bfloat16) for name, each in weights.items()}
    settings.pop("data", None)  # a path of the machine that trained
    settings |= {"rounded": "bfloat16", "trained_steps": trained_steps(run)}
    with new_folder(out, description={"share": str(path)}) as partial:
        shared = RunFolder(partial)
        shared.create()
        shared.write_snapshot(record["step"], rounded, {"agent": record["agent"]})
        write_json(shared.settings, settings)
    return RunFolder(out).snapshot(record["step"])
