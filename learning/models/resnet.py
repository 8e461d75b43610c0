"""The 43-layer fully convolutional network behind every heat map, and its width variants.

Source: Zeng et al., Transporter Networks, CoRL 2020; Seita et al., ICRA 2021, appendix on models.
What their code does, and this file keeps:

- bottlenecks (1x1, 3x3, 1x1 and a shortcut) with the ReLU after the sum, biases everywhere and no
  normalisation layer; stride 2 stands on the first 1x1 and on the shortcut, nothing is pooled;
- the last stage is [16, 16, out] without a ReLU after its sums, so a heat map is unbounded;
- weights start Glorot-uniform, biases at zero;
- maps grow by bilinear interpolation with half-pixel centres.

One rewriting, which changes rounding only: a 1x1 convolution and bilinear interpolation commute
(the weights of interpolation sum to 1), so the decoder convolves first and interpolates the fewer
channels of the smaller result.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError

__all__ = ["STRIDE", "ResNet43", "receptive_span"]

STRIDE = 8
"""Height and width of an input are multiples of this [pixels]: the smallest map has 1/8 of them."""
_CHANNELS = (64, 128, 256, 512)
_HEAD_CHANNELS = 16
_GROWING = 3
"""Stages at the end that double the map; as many at the beginning halve it or keep it whole."""


class ResNet43(nn.Module):
    """Image (B, C, H, W) -> map (B, out, H, W) float32 of the same height and width.

    57 convolutions; 9,833,203 parameters for 6 channels -> 1 at width 1. `width` scales the 64,
    128, 256 and 512 channels of the stages, 8 at least; the last stage keeps its 16.

    Args:
        in_channels: channels of the image
        out_channels: channels of the map
        width: channels relative to the original's
        skips: join finer features to the coarse ones that grow, as U-Nets do (ours)
        bfloat16: convolve in bfloat16 (weights, gradients and the returned map stay float32)
        generator: draws the initial weights

    Raises:
        InputError: a width that is not positive; in `forward`, a side that is no multiple of 8.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        width: float = 1.0,
        skips: bool = False,
        bfloat16: bool = False,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if not (math.isfinite(width) and width > 0):
            raise InputError(f"width: a positive number is needed, got {width!r}")
        c1, c2, c3, c4 = (max(8, round(channels * width)) for channels in _CHANNELS)
        self.bfloat16 = bfloat16
        self.stem = _convolution(in_channels, c1, 3)
        self.stages = nn.ModuleList(
            [
                _Stage(c1, c1, c1),
                _Stage(c1, c2, c2, stride=2),
                _Stage(c2, c3, c3, stride=2),
                _Stage(c3, c4, c4, stride=2),
                _Stage(c4, c3, c3),
                _Stage(c3, c2, c2, upsample=True),
                _Stage(c2, c1, c1, upsample=True),
                _Stage(c1, _HEAD_CHANNELS, out_channels, upsample=True, activate=False),
            ]
        )
        self.laterals = nn.ModuleList(
            [_convolution(*c, 1) for c in ((c3, c2), (c2, c1), (c1, _HEAD_CHANNELS)) if skips]
        )
        for convolution in self.convolutions():
            nn.init.xavier_uniform_(convolution.weight, generator=generator)
            nn.init.zeros_(convolution.bias)

    def convolutions(self) -> list[nn.Conv2d]:
        """In order: the stem; for every stage 1x1, 3x3, 1x1, shortcut, then 1x1, 3x3, 1x1.

        With `skips`, three 1x1 come last.
        """
        return [module for module in self.modules() if isinstance(module, nn.Conv2d)]

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, out, H, W) float32 of an image (B, C, H, W)."""
        height, width = x.shape[-2:]
        if height % STRIDE or width % STRIDE:
            raise InputError(
                f"image: sides must be multiples of {STRIDE} pixels, got {height} x {width}"
            )
        # On CPUs convolutions and interpolation of few channels run up to 4 times faster so.
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.bfloat16):
            x = functional.relu(self.stem(x), inplace=True)
            finer: list[Tensor] = []
            for stage in self.stages[:-_GROWING]:
                x = stage(x)
                finer.append(x)
            for k, stage in enumerate(self.stages[-_GROWING:]):
                lateral = self.laterals[k](finer[_GROWING - 1 - k]) if self.laterals else None
                x = stage(x, lateral)
        return x.float()


class _Stage(nn.Module):
    """A projection block, then an identity block."""

    def __init__(
        self,
        in_channels: int,
        middle: int,
        out_channels: int,
        *,
        stride: int = 1,
        upsample: bool = False,
        activate: bool = True,
    ) -> None:
        super().__init__()
        self.project = _Block(
            in_channels,
            middle,
            out_channels,
            shortcut=True,
            stride=stride,
            upsample=upsample,
            activate=activate,
        )
        self.identity = _Block(out_channels, middle, out_channels, activate=activate)

    def forward(self, x: Tensor, lateral: Tensor | None = None) -> Tensor:
        y: Tensor = self.identity(self.project(x, lateral))
        return y


class _Block(nn.Module):
    """Bottleneck: 1x1, ReLU, 3x3, ReLU, 1x1, plus the shortcut, then (if `activate`) ReLU.

    The modules are registered in the order in which `ResNet43.convolutions` promises them.
    """

    def __init__(
        self,
        in_channels: int,
        middle: int,
        out_channels: int,
        *,
        shortcut: bool = False,
        stride: int = 1,
        upsample: bool = False,
        activate: bool,
    ) -> None:
        super().__init__()
        self.reduce = _convolution(in_channels, middle, 1)
        self.spatial = _convolution(middle, middle, 3)
        self.expand = _convolution(middle, out_channels, 1)
        self.shortcut = _convolution(in_channels, out_channels, 1) if shortcut else None
        self.stride = stride
        self.upsample = upsample
        self.activate = activate

    def forward(self, x: Tensor, lateral: Tensor | None = None) -> Tensor:
        """`lateral` (B, middle, H, W) joins the bottleneck before its 3x3 convolution."""
        if self.stride > 1:
            # In place of convolutions with a stride: for fewer than 16 channels stored last, their
            # weight gradient writes out of bounds (uxlfoundation/oneDNN issue 6035, torch 2.13).
            x = x[:, :, :: self.stride, :: self.stride]
            x = x.contiguous(memory_format=torch.channels_last)
        y = self.reduce(x)
        if self.shortcut is not None:
            x = self.shortcut(x)
        if self.upsample:
            x, y = _twice(x), _twice(y)
        if lateral is not None:
            y = y + lateral
        y = functional.relu(self.spatial(functional.relu(y, inplace=True)), inplace=True)
        y = self.expand(y) + x
        return functional.relu(y, inplace=True) if self.activate else y


def _convolution(in_channels: int, out_channels: int, size: int) -> nn.Conv2d:
    """A convolution whose weights are still unset, so that no global generator draws them."""
    convolution: nn.Conv2d = nn.utils.skip_init(
        nn.Conv2d, in_channels, out_channels, size, padding=size // 2
    )
    return convolution


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def receptive_span(start: int, stop: int) -> tuple[int, int]:
    """Input rows [start, stop) on which output rows [start, stop) of a `ResNet43` depend.

    The result may reach outside of the image, where the network sees its own zero padding.

    >>> receptive_span(160, 161)
    (89, 224)
    """
    first, last = start, stop - 1
    for _ in range(3):  # the three stages after an interpolation: two 3x3 convolutions, then twice
        first, last = (first - 2) - 1, (last + 2) + 1
        first, last = first // 2, last // 2
    first, last = first - 4, last + 4  # the stages of 512 and 256 channels at 1/8
    for _ in range(3):  # every second pixel, then two 3x3 convolutions
        first, last = 2 * first - 2, 2 * last + 2
    return first - 1, last + 2
