"""`Push`: a bounded acceleration of one particle, which brings an object out of order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here


MOST_PUSHES = 2
"""So many particles of a world may be pushed at once."""


@dataclass(frozen=True, eq=False)
class Push:
    """One particle is accelerated for a while.

    Attributes:
        acceleration: (3,) [m/s^2], on top of gravity
    """

    particle: int
    acceleration: np.ndarray
    seconds: float
