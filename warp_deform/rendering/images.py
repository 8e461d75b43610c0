"""`Images`: colour, height and segmentation of the table, seen from straight above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Images"]


@dataclass(frozen=True, eq=False)
class Images:
    """Top-down views of one state: rows are y, columns are x, 3.125 mm a pixel.

    Attributes:
        color: (320, 160, 3) uint8
        height: (320, 160) float32 [m]
        segmentation: (320, 160) uint8
    """

    color: np.ndarray
    height: np.ndarray
    segmentation: np.ndarray
