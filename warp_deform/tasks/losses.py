"""Smooth stand-ins for what is left to do, for gradients: distances under the best map, areas.

They take tensors of any precision and keep the graph; what they compare with are plain arrays.
Leading dimensions are worlds side by side: each gets the bits that it has alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["cover_distance", "grid_maps", "lengths", "mean_distance", "ring_area"]


def lengths(offsets: Tensor) -> Tensor:
    """Lengths (...) of `offsets` (..., d); a tenth of a millimetre rounds the tip of the norm."""
    return (offsets.square().sum(-1) + 1e-8).sqrt()  # whose slope at nought is none


def mean_distance(points: Tensor, targets: np.ndarray, maps: np.ndarray) -> Tensor:
    """Mean distance (...) [m] of `points` (..., n, d) from `targets` under the best of the maps.

    Args:
        targets: (..., n, d)
        maps: (m, n), entry j of a map is the point for target j
    """
    import torch

    goals = points.new_tensor(np.asarray(targets, dtype=float))
    mapped = points[..., torch.as_tensor(np.ascontiguousarray(maps)), :]
    offsets = mapped - goals[..., None, :, :]
    return lengths(offsets).mean(-1).amin(-1)


def ring_area(beads: Tensor) -> Tensor:
    """Area (...) [m^2] that a closed chain (..., n, 2 or 3) encloses from above, in its own order.

    Loops that run the other way round count against it. Source: the shoelace formula.
    """
    x, y = beads[..., 0], beads[..., 1]
    return 0.5 * (x * y.roll(-1, -1) - y * x.roll(-1, -1)).sum(-1).abs()


def cover_distance(vertices: Tensor, points: Tensor, softness: float) -> Tensor:
    """Mean over `points` (n, 2) [m] of the soft distance to the nearest of `vertices` (v, 3).

    Args:
        softness: distances that differ by less [m] count alike
    """
    import torch

    offsets = vertices[None, :, :2] - points[:, None, :]
    return (-softness * torch.logsumexp(-lengths(offsets) / softness, dim=1)).mean()


def grid_maps(rows: int, columns: int) -> np.ndarray:
    """Ways (m, rows * columns) to lay a grid of vertices onto its own outline.

    Quarter turns and mirror images; of a grid that is not square, half turns.
    """
    grid = np.arange(rows * columns).reshape(rows, columns)
    turns = range(4) if rows == columns else (0, 2)
    ways = [np.rot90(side, turn) for side in (grid, grid[:, ::-1]) for turn in turns]
    return np.stack([way.ravel() for way in ways])
