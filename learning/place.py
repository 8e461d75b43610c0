"""Where training runs: threads, device, and the other processes under `torchrun`."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import NamedTuple

import torch

from warp_deform.errors import InputError

__all__ = ["Place", "place"]


class Place(NamedTuple):
    """This process among the others.

    rank: 0 for the one that writes; world: their number
    """

    rank: int
    world: int
    device: torch.device

    def wait(self) -> None:
        """Wait for the others."""
        if self.world > 1:
            torch.distributed.barrier()


@contextlib.contextmanager
def place(device: str, *, threads: int) -> Iterator[Place]:
    """Join the processes that `torchrun` started, if it did, and use `threads` threads of torch.

    Raises:
        InputError: there is no such device.
    """
    if device not in ("cpu", "cuda"):
        raise InputError(f"device is {device!r}; it must be 'cpu' or 'cuda'")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("torch sees no CUDA device here; train with --device cpu")
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    here = torch.device(device)
    if device == "cuda":
        here = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    if world > 1:
        torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield Place(rank, world, here)
    finally:
        if world > 1:
            torch.distributed.destroy_process_group()
        torch.set_num_threads(before)
