"""The processes that train together under `torchrun`: their ranks, devices and threads."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from datetime import timedelta
from typing import NamedTuple

import torch

from warp_deform.errors import InputError

__all__ = ["DEVICES", "Process", "join_processes", "rank"]

DEVICES = ("cpu", "cuda")
"""Where networks can be trained, by the names of the command line."""
_PATIENCE = timedelta(days=2)
"""The others wait while the first one plays validation episodes, which may take hours; torch's own
limit is 10 or 30 minutes. When a process fails, torchrun ends the others at once."""


class Process(NamedTuple):
    """This process among those that train together.

    Attributes:
        rank: 0 for the one that writes
        world: their number
    """

    rank: int
    world: int
    device: torch.device

    def wait(self) -> None:
        """Wait for the others."""
        if self.world > 1:
            torch.distributed.barrier()


def rank() -> int:
    """Number of this process among those that torchrun started; 0 without it."""
    return int(os.environ.get("RANK", 0))


@contextlib.contextmanager
def join_processes(device: str, *, threads: int) -> Iterator[Process]:
    """Join the processes that `torchrun` started, if it did, and use `threads` threads of torch.

    Raises:
        InputError: there is no such device, or not one for every process.
    """
    if device not in DEVICES:
        raise InputError(f"device is {device!r}; it must be 'cpu' or 'cuda'")
    world, torch_device = int(os.environ.get("WORLD_SIZE", 1)), torch.device(device)
    if device == "cuda":
        torch_device = _own_gpu()
        torch.cuda.set_device(torch_device)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    if world > 1:
        torch.distributed.init_process_group(
            "nccl" if device == "cuda" else "gloo",
            timeout=_PATIENCE,
            device_id=torch_device if device == "cuda" else None,
        )
    try:
        yield Process(rank(), world, torch_device)
    finally:
        if world > 1:
            torch.distributed.destroy_process_group()
        torch.set_num_threads(before)


def _own_gpu() -> torch.device:
    """The GPU of this process among those of its machine."""
    if not torch.cuda.is_available():
        raise InputError("torch sees no CUDA device here; train with --device cpu")
    own, count = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
    if own >= count:
        raise InputError(
            f"torchrun started {own + 1} or more processes here, and torch sees {count} GPU(s); "
            f"use --nproc-per-node {count}"
        )
    return torch.device("cuda", own)
