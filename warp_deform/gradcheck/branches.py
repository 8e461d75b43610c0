"""Which branches the worlds of a taped rollout took."""

from __future__ import annotations

import numpy as np

from ..rollout.differentiable import DifferentiableRollout
from ..xpbd.lanes.tape import Kind

__all__ = ["SMOOTH", "counted", "taken"]

SMOOTH = (Kind.TABLE_SLIP, Kind.BODY_SLIP)
"""Counted, but no branches: the edge between sticking and sliding."""


def taken(run: DifferentiableRollout) -> list[np.ndarray]:
    """Of each world: who touched whom in every substep, and where on its path the tip was.

    That is all that whole numbers on the tape say. `run` keeps its tapes (storage "full") and has
    one lane a group.
    """
    words: list[list[np.ndarray]] = []
    for tape in (segment.tape for segment in run.recorder._segments):
        assert tape is not None
        whole, first, top = (tape.arrays[name].numpy() for name in ("k", "first", "top"))
        words.append([whole[a:b].copy() for a, b in zip(first[:, 2], top[:, 2], strict=True)])
    return [np.concatenate(parts) for parts in zip(*words, strict=True)]


def counted(fired: np.ndarray) -> np.ndarray:
    """Counts (..., kinds) of what is a branch."""
    return np.delete(fired, [int(kind) for kind in SMOOTH], axis=-1)
