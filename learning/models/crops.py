"""Square crops around picked pixels, turned by equal steps.

Source: Zeng et al., CoRL 2020 (rotated crops as kernels). Their code turns the whole map and crops
it afterwards; here only the pixels of the crop are sampled, by the same coordinates in the same
precision, so the result is equal bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

__all__ = ["CropPixels", "crop_pixels", "crop_reach", "crops_at", "rotated_crops"]


class CropPixels(NamedTuple):
    """Which pixels of maps crops are made of.

    Attributes:
        where: (B, R size size) int64, pixels of the maps, counted row by row
        inside: (B, R size size) bool; where it is False, zero is seen
    """

    where: Tensor
    inside: Tensor


def rotated_crops(
    features: Tensor,
    centres: Tensor,
    *,
    size: int,
    n_rotations: int,
    origin: tuple[int, int] = (0, 0),
    shape: tuple[int, int] | None = None,
) -> Tensor:
    """Crops (B, R, C, size, size) of maps, the i-th turned by 2 pi i / R about its centre.

    The centre is pixel (size / 2, size / 2) of the crop. Sampling takes the nearest pixel; a source
    coordinate half way between two rounds away from zero, and what lies outside of the map is zero.
    A crop's pixel (x, y) = (column, row) reads the map where the rotation matrix sends it.

    Args:
        features: (B, C, H, W), the maps or windows of them
        centres: (B, 2) int64 on the CPU, row and column in the map; unturned crops must fit
        size: side of a crop [pixels]
        n_rotations: R
        origin: row and column of the window's first pixel in the map
        shape: height and width of the map, by default those of `features`
    """
    half = size // 2
    if n_rotations == 1:
        corners = (centres - torch.tensor(origin) - half).tolist()
        pieces = [
            map_[:, row : row + size, column : column + size]
            for map_, (row, column) in zip(features, corners, strict=True)
        ]
        return torch.stack(pieces)[:, None]
    pixels = crop_pixels(
        centres,
        size=size,
        n_rotations=n_rotations,
        shape=shape or (features.shape[2], features.shape[3]),
        origin=origin,
        columns=features.shape[3],
    )
    there = CropPixels(*(each.to(features.device) for each in pixels))
    return crops_at(features, there, size=size)


def crop_pixels(
    centres: Tensor,
    *,
    size: int,
    n_rotations: int,
    shape: tuple[int, int],
    origin: tuple[int, int] = (0, 0),
    columns: int | None = None,
) -> CropPixels:
    """The pixels, on the CPU, that `rotated_crops` reads; its arguments are that function's.

    Args:
        columns: of the windows, where it is not the map's
    """
    v, u = _sources(centres.numpy(), size=size, n_rotations=n_rotations)
    inside = (u >= 0) & (u < shape[0]) & (v >= 0) & (v < shape[1])
    u, v = np.where(inside, u - origin[0], 0), np.where(inside, v - origin[1], 0)
    where = u * (columns or shape[1]) + v
    return CropPixels(
        torch.from_numpy(where.reshape(len(where), -1)),
        torch.from_numpy(inside.reshape(len(inside), -1)),
    )


def crops_at(features: Tensor, pixels: CropPixels, *, size: int) -> Tensor:
    """Crops (B, R, C, size, size) of maps (B, C, H, W) on the same device."""
    batch, channels = features.shape[:2]
    where, inside = (each[:, None] for each in pixels)
    sampled = features.flatten(2).gather(2, where.expand(-1, channels, -1))
    sampled = torch.where(inside, sampled, torch.zeros((), device=features.device))
    return sampled.reshape(batch, channels, -1, size, size).transpose(1, 2)


def crop_reach(size: int, n_rotations: int) -> int:
    """Greatest distance [pixels] along an axis from a crop's centre to a pixel that it samples.

    Examples:
        >>> crop_reach(64, 1), crop_reach(64, 24)
        (32, 46)
    """
    half = size // 2
    return half if n_rotations == 1 else int(np.ceil(np.hypot(half, half)))


def _sources(centres: np.ndarray, *, size: int, n_rotations: int) -> tuple[np.ndarray, np.ndarray]:
    """Source columns and rows (B, R, size, size) int64 of crops' pixels, in the map.

    The matrix is rounded to float32 and applied in float32: where a coordinate falls half way
    between two pixels (a cosine of 0.5, say), rounding decides which one is seen.
    """
    theta = 2 * np.pi * np.arange(n_rotations) / n_rotations
    cosine, sine = np.cos(theta), np.sin(theta)
    row, column = centres[:, :1].astype(float), centres[:, 1:].astype(float)
    shift_x = column - cosine * column + sine * row
    shift_y = row - sine * column - cosine * row
    steps = np.arange(size) - size // 2
    x = (centres[:, 1, None] + steps).astype(np.float32)[:, None, None, :]
    y = (centres[:, 0, None] + steps).astype(np.float32)[:, None, :, None]
    c, s = (values.astype(np.float32)[None, :, None, None] for values in (cosine, sine))
    tx, ty = (values.astype(np.float32)[:, :, None, None] for values in (shift_x, shift_y))
    return _half_away(c * x - s * y + tx), _half_away(s * x + c * y + ty)


def _half_away(values: np.ndarray) -> np.ndarray:
    """Nearest integers int64, halves away from zero (NumPy's and torch's go to even)."""
    exact = values.astype(float)
    return np.trunc(exact + np.copysign(0.5, exact)).astype(np.int64)
