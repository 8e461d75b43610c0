"""What the networks see: colour and height as one tensor, at the camera's resolution or coarser.

Source: Seita et al., ICRA 2021, appendix on models (six channels: colour, and height three times).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from warp_deform.errors import InputError

__all__ = ["CHANNELS", "NETWORK_CHANNELS", "image_tensor", "normalise"]

CHANNELS = 4
"""Channels of one image: red, green, blue (0 to 255) and height [m]."""
NETWORK_CHANNELS = 6
"""What a network sees of one image: colour, and the height three times."""
# Means and standard deviations of the original's data: colour in [0, 1], height in m.
_COLOR_MEAN, _COLOR_STD = 0.18877631, 0.07276466
_HEIGHT_MEAN, _HEIGHT_STD = 0.00509261, 0.00903967


def image_tensor(
    color: np.ndarray, height: np.ndarray, *, scale: int = 1, fine: bool = False
) -> Tensor:
    """Raw image (4, H / scale, W / scale) float32: colour 0 to 255, then height [m].

    A pixel of a coarser image is the mean of the `scale` x `scale` pixels that it covers. With
    `fine` they stand side by side instead, as `scale`^2 images: every pixel of the first has the
    first of the pixels that it covers, row by row, and so on; (4 scale^2, H / scale, W / scale).

    Args:
        color: (H, W, 3) uint8
        height: (H, W) float32 [m]
        scale: camera pixels along the side of an image pixel
        fine: keep the pixels that a coarser one covers

    Raises:
        InputError: shapes that do not belong together, or that `scale` does not divide.
    """
    rows, columns = height.shape
    if color.shape != (rows, columns, 3):
        raise InputError(f"color: shape {(rows, columns, 3)} is needed, got {color.shape}")
    if scale < 1 or rows % scale or columns % scale:
        raise InputError(f"scale: must divide {rows} and {columns}, got {scale}")
    image = np.concatenate([color.transpose(2, 0, 1), height[None]], dtype=np.float32)
    if scale > 1:
        blocks = image.reshape(CHANNELS, rows // scale, scale, columns // scale, scale)
        if fine:
            image = blocks.transpose(2, 4, 0, 1, 3).reshape(-1, rows // scale, columns // scale)
        else:
            image = blocks.mean(axis=(2, 4))
    return torch.from_numpy(image)


def normalise(image: Tensor) -> Tensor:
    """Network input (B, 6 k, H, W) of k raw images (B, 4 k, H, W), height tiled to three channels.

    Pad before: the zeros around a raw image become about -2.6 (colour) and -0.56 (height) here, as
    in the original, while a rotation that follows fills with zeros of this normalised space.

    Raises:
        InputError: a number of channels that is no multiple of 4.
    """
    batch, channels, height, width = image.shape
    if channels % CHANNELS:
        raise InputError(f"image: channels must be a multiple of {CHANNELS}, got {channels}")
    images = image.reshape(batch, -1, CHANNELS, height, width)
    color = (images[:, :, :3] / 255 - _COLOR_MEAN) / _COLOR_STD
    tiled = ((images[:, :, 3:] - _HEIGHT_MEAN) / _HEIGHT_STD).expand(-1, -1, 3, -1, -1)
    return torch.cat([color, tiled], dim=2).flatten(1, 2)
