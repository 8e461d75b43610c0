"""A policy to hand on: a run's folder with the chosen snapshot alone, in half its bytes."""

from __future__ import annotations

from pathlib import Path

import torch

from warp_deform.errors import InputError

from .snapshots import RunFolder, read_json, read_snapshot, write_json

__all__ = ["share_run"]


def share_run(path: Path, out: Path) -> Path:
    """Write the snapshot that `eval` chose into a folder of its own; returns the weights' path.

    Weights are rounded to bfloat16 and read back as float32, so results may differ from the run's
    in a few episodes: `warp-deform eval` tests the folder like any run's. Training does not go on
    from it.

    Raises:
        InputError: there is no snapshot, or `out` exists.
    """
    run, shared = RunFolder(path), RunFolder(out)
    file = run.chosen_snapshot()
    weights, record = read_snapshot(file)
    if shared.path.exists():
        raise InputError(f"{shared.path} exists; name a folder to be made")
    shared.create()
    rounded = {name: each.to(torch.bfloat16) for name, each in weights.items()}
    written = shared.write_snapshot(record["step"], rounded, {"agent": record["agent"]})
    settings = read_json(run.settings)
    settings.pop("data")  # a path of the machine that trained
    write_json(shared.settings, {**settings, "rounded": "bfloat16"})
    return written
