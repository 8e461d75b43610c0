"""`GroupLaunch`: one kernel over all groups of worlds, shared by several threads."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from ..support.threads import call_side_by_side

__all__ = ["GroupLaunch"]

PARTS = 2
"""Parts a thread: groups differ in what they cost, and whoever is done takes another part."""
LEAST = 4000
"""Particles and bodies, times substeps, that are worth waking a thread: about a millisecond."""


class GroupLaunch:
    """A launch of a kernel over groups of worlds, recorded so that it is cheap to repeat.

    On the CPU, Warp runs the groups of a launch one after the other, and without Python's lock. So
    they are cut into parts, which `threads` threads take in turns. A group reads and writes nothing
    that another one writes: neither cutting nor order changes a bit.

    Recording loads the kernel's module, and every part has a `wp.Launch` and arguments of its own;
    what threads still share in Warp is a pointer to memory of tiles, which these kernels have not.

    Args:
        inputs: all arguments but the last, which is the number of the first group
        size: particles and bodies of all groups
    """

    def __init__(
        self,
        kernel: Any,
        inputs: list[Any],
        *,
        groups: int,
        size: int,
        device: Any,
        threads: int,
    ) -> None:
        self._threads, self._size = threads, size
        parts = min(groups, PARTS * threads) if threads > 1 else 1
        starts = np.linspace(0, groups, parts + 1).astype(int).tolist()
        self._parts = [
            wp.launch(
                kernel,
                dim=end - first,
                inputs=[*inputs, first],
                device=device,
                record_cmd=True,
                record_tape=False,
            )
            for first, end in pairwise(starts)
        ]

    def set_param_at_index(self, index: int, value: Any) -> None:
        """Replace an argument."""
        for part in self._parts:
            part.set_param_at_index(index, value)

    def launch(self, substeps: int) -> None:
        """Run all groups, of which each does up to so many substeps, and return at their end."""
        threads = self._threads if self._size * substeps >= LEAST else 1
        call_side_by_side([part.launch for part in self._parts], threads)
