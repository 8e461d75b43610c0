"""Which of a task's lifts to carry at, predicted from the image around the picked point.

The original chooses the height of the motion by a hidden stage read from the simulator; here it is
part of the action and predicted from the crop around the pick.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError

from .crops import CropPixels, crop_pixels, crops_at, rotated_crops
from .images import CHANNELS, NETWORK_CHANNELS, normalise

__all__ = ["LiftHead"]

_CHANNELS = (16, 32, 64, 64)
_GRID = 4


class LiftHead(nn.Module):
    """Raw images (B, 4 k, H, W) and picked pixels (B, 2) -> logits (B, n_lifts).

    A 3x3 convolution of stride 2 halves the crop until 4 x 4 is left, then one linear layer. Only
    the current image is seen, not the goal's. About 64,000 parameters at a crop of 64.

    Args:
        n_lifts: lifts to choose from, 2 or more
        images: what the current picture becomes, see `images.image_tensor`
        crop: side of the crop [pixels], 4 times a power of two, 8 to 64
        generator: draws the initial weights

    Raises:
        InputError: fewer than two lifts, or another crop.
    """

    def __init__(
        self, n_lifts: int, *, images: int = 1, crop: int = 64, generator: torch.Generator
    ) -> None:
        super().__init__()
        halvings = round(math.log2(max(crop, 1) / _GRID))
        if crop != _GRID * 2**halvings or not 1 <= halvings <= len(_CHANNELS):
            raise InputError(
                f"crop: 8, 16, 32 or 64 pixels are possible for a lift head, got {crop}"
            )
        if n_lifts < 2:
            raise InputError(f"n_lifts: nothing to choose among {n_lifts}")
        self.crop = crop
        self.channels = CHANNELS * images
        widths = (NETWORK_CHANNELS * images, *_CHANNELS[-halvings:])
        self.convolutions = nn.ModuleList(
            nn.utils.skip_init(nn.Conv2d, before, after, 3, stride=2, padding=1)
            for before, after in pairwise(widths)
        )
        self.choose = nn.utils.skip_init(nn.Linear, widths[-1] * _GRID**2, n_lifts)
        for layer in (*self.convolutions, self.choose):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)

    def forward(self, image: Tensor, pick: Tensor) -> Tensor:
        """Logits (B, n_lifts); `pick` (B, 2) int64 row and column within the image."""
        x, half = self._framed(image), self.crop // 2
        return self._chosen(rotated_crops(x, pick.cpu() + half, size=self.crop, n_rotations=1))

    def at(self, image: Tensor, pixels: CropPixels) -> Tensor:
        """As `forward`, given the `crop_pixels` of the picks, on the image's device."""
        return self._chosen(crops_at(self._framed(image), pixels, size=self.crop))

    def crop_pixels(self, pick: Tensor, shape: tuple[int, int]) -> CropPixels:
        """What `at` cuts out of images of a shape (H, W) for picks (B, 2), on the CPU."""
        framed = shape[0] + self.crop, shape[1] + self.crop
        centres = pick + self.crop // 2
        return crop_pixels(centres, size=self.crop, n_rotations=1, shape=framed)

    def _framed(self, image: Tensor) -> Tensor:
        half = self.crop // 2
        return normalise(functional.pad(image[:, : self.channels], (half, half, half, half)))

    def _chosen(self, crops: Tensor) -> Tensor:
        x = crops[:, 0]
        for convolution in self.convolutions:
            x = functional.relu(convolution(x), inplace=True)
        logits: Tensor = self.choose(x.flatten(1))
        return logits
