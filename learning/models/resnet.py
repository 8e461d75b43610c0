"""The 43-layer fully convolutional network behind every heat map, and its width variants.

Source: Zeng et al., Transporter Networks, CoRL 2020; Seita et al., ICRA 2021, appendix on models.
What their code does, and this file keeps:

- bottlenecks (1x1, 3x3, 1x1 and a shortcut) with the ReLU after the sum, biases everywhere and no
  normalisation layer; stride 2 stands on the first 1x1 and on the shortcut, nothing is pooled;
- the last stage is [16, 16, out] without a ReLU after its sums, so a heat map is unbounded;
- weights start Glorot-uniform, biases at zero;
- maps grow by bilinear interpolation with half-pixel centres.

Ours, and off by default: fewer channels, skip connections, and features that turn with the picture
(quarter_turns.py), for which means of four pixels take the place of every second one.

One rewriting, which changes rounding only: a 1x1 convolution and bilinear interpolation commute
(the weights of interpolation sum to 1), so the decoder convolves first and interpolates the fewer
channels of the smaller result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError

from .images import NETWORK_CHANNELS
from .quarter_turns import TURNS, Field, QuarterTurnConvolution

__all__ = ["GROWING", "STRIDE", "NetworkConfig", "ResNet43", "receptive_span", "shrunk"]

STRIDE = 8
"""Height and width of an input are multiples of this [pixels]: the smallest map has 1/8 of them."""
_CHANNELS = (64, 128, 256, 512)
_HEAD_CHANNELS = 16
GROWING = 3
"""Stages at the end that double the map; as many at the beginning halve it or keep it whole."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """What the networks of an agent have in common; the defaults are the paper's."""

    width: float = 1.0
    """Channels of the stages relative to the original's 64 to 512, 8 at least."""
    skips: bool = False
    """Finer features join the coarse ones that grow, as in U-Nets."""
    equivariant: bool = False
    """When the picture makes quarter turns, so does the map (quarter_turns.py)."""
    subpixels: int = 1
    """Side of the square of camera pixels that stand in a pixel's channels."""
    bfloat16: bool = False
    """Convolve in bfloat16; weights, gradients and the returned map stay float32."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.width) and self.width > 0):
            raise InputError(f"width: a positive number is needed, got {self.width!r}")
        if self.subpixels < 1:
            raise InputError(f"subpixels: at least 1 is needed, got {self.subpixels}")

    @property
    def channels(self) -> list[int]:
        """Channels of the stages, from the finest to the coarsest."""
        step = TURNS if self.equivariant else 1
        return [max(8, round(full * self.width / step) * step) for full in _CHANNELS]


class ResNet43(nn.Module):
    """Pictures (B, C, H, W) -> map (B, out, H, W) float32 of the same height and width.

    57 convolutions; 9,833,203 parameters for one picture -> 1 by default.

    Args:
        out_channels: channels of the map
        pictures: seen by the network, each `NETWORK_CHANNELS` channels, times `subpixels` squared
        config: width and kind
        marks: channels of a map that joins the first features, see `forward`
        generator: draws the initial weights

    Raises:
        InputError: in `forward`, a side that is no multiple of 8, or a mark that is missing.
    """

    def __init__(
        self,
        out_channels: int,
        *,
        pictures: int = 1,
        config: NetworkConfig = NetworkConfig(),
        marks: int = 0,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        c1, c2, c3, c4 = config.channels
        turns, seen = config.equivariant, NETWORK_CHANNELS * pictures * config.subpixels**2
        self.bfloat16, self.pictures_channels, self.out_channels = (
            config.bfloat16,
            seen,
            out_channels,
        )
        self.stem: nn.Module = (
            QuarterTurnConvolution(
                seen, c1, 3, reads="plain", pictures=pictures, subpixels=config.subpixels
            )
            if turns
            else _convolution(seen, c1, 3)
        )
        self.stages = nn.ModuleList(
            [
                _Stage(c1, c1, c1, turns=turns),
                _Stage(c1, c2, c2, turns=turns, stride=2),
                _Stage(c2, c3, c3, turns=turns, stride=2),
                _Stage(c3, c4, c4, turns=turns, stride=2),
                _Stage(c4, c3, c3, turns=turns),
                _Stage(c3, c2, c2, turns=turns, upsample=True),
                _Stage(c2, c1, c1, turns=turns, upsample=True),
                _Stage(c1, _HEAD_CHANNELS, out_channels, turns=turns, upsample=True, last=True),
            ]
        )
        joined = ((c3, c2), (c2, c1), (c1, _HEAD_CHANNELS)) if config.skips else ()
        self.laterals = nn.ModuleList([_convolution(*each, 1, turns=turns) for each in joined])
        self.mark = _convolution(marks, c1, 3, turns=turns, reads="plain") if marks else None
        for convolution in self.convolutions():
            if isinstance(convolution, QuarterTurnConvolution):
                convolution.draw(generator)
            else:
                nn.init.xavier_uniform_(convolution.weight, generator=generator)
                nn.init.zeros_(convolution.bias)

    def convolutions(self) -> list[nn.Conv2d | QuarterTurnConvolution]:
        """In order: the stem; for every stage 1x1, 3x3, 1x1, shortcut, then 1x1, 3x3, 1x1.

        Then the three 1x1 of `skips` and the 3x3 of `marks`, where there are any.
        """
        kinds = (nn.Conv2d, QuarterTurnConvolution)
        return [module for module in self.modules() if isinstance(module, kinds)]

    def forward(self, x: Tensor, mark: Tensor | None = None) -> Tensor:
        """Map (B, out, H, W) float32 of an image (B, C, H, W), and of a map (B, marks, H, W)."""
        height, width = x.shape[-2:]
        if height % STRIDE or width % STRIDE:
            raise InputError(
                f"image: sides must be multiples of {STRIDE} pixels, got {height} x {width}"
            )
        if (mark is None) != (self.mark is None):
            raise InputError("mark: a network with marks needs one, others take none")
        # On CPUs convolutions and interpolation of few channels run up to 4 times faster so.
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.bfloat16):
            x = self.stem(x)
            if self.mark is not None:
                x = x + self.mark(mark)
            x = functional.relu(x, inplace=True)
            finer: list[Tensor] = []
            for stage in self.stages[:-GROWING]:
                x = stage(x)
                finer.append(x)
            for k, stage in enumerate(self.stages[-GROWING:]):
                lateral = self.laterals[k](finer[GROWING - 1 - k]) if self.laterals else None
                x = stage(x, lateral)
        return x.float()


class _Stage(nn.Module):
    """A projection block, then an identity block; `last` returns a map that is unbounded."""

    def __init__(
        self,
        in_channels: int,
        middle: int,
        out_channels: int,
        *,
        turns: bool = False,
        stride: int = 1,
        upsample: bool = False,
        last: bool = False,
    ) -> None:
        super().__init__()
        self.project = _Block(
            in_channels,
            middle,
            out_channels,
            turns=turns,
            shortcut=True,
            stride=stride,
            upsample=upsample,
            gives="plain" if last else "regular",
        )
        field: Field = "plain" if last else "regular"
        self.identity = _Block(
            out_channels, middle, out_channels, turns=turns, reads=field, gives=field
        )

    def convolutions(self) -> list[nn.Module]:
        """As `ResNet43.convolutions`, of this stage; in the order in which they are registered."""
        blocks = (self.project, self.identity)
        return [
            each
            for block in blocks
            for each in (block.reduce, block.spatial, block.expand, block.shortcut)
            if each is not None
        ]

    def forward(self, x: Tensor, lateral: Tensor | None = None) -> Tensor:
        y: Tensor = self.identity(self.project(x, lateral))
        return y


class _Block(nn.Module):
    """Bottleneck: 1x1, ReLU, 3x3, ReLU, 1x1, plus the shortcut, then ReLU unless what it gives is
    plain.

    The modules are registered in the order in which `ResNet43.convolutions` promises them.
    """

    def __init__(
        self,
        in_channels: int,
        middle: int,
        out_channels: int,
        *,
        turns: bool,
        shortcut: bool = False,
        stride: int = 1,
        upsample: bool = False,
        reads: Field = "regular",
        gives: Field = "regular",
    ) -> None:
        super().__init__()
        self.reduce = _convolution(in_channels, middle, 1, turns=turns, reads=reads)
        self.spatial = _convolution(middle, middle, 3, turns=turns)
        self.expand = _convolution(middle, out_channels, 1, turns=turns, gives=gives)
        self.shortcut = (
            _convolution(in_channels, out_channels, 1, turns=turns, reads=reads, gives=gives)
            if shortcut
            else None
        )
        self.turns = turns
        self.stride = stride
        self.upsample = upsample
        self.activate = gives == "regular"

    def forward(self, x: Tensor, lateral: Tensor | None = None) -> Tensor:
        """`lateral` (B, middle, H, W) joins the bottleneck before its 3x3 convolution."""
        x = shrunk(x, self.stride, turns=self.turns)
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


def _convolution(
    in_channels: int,
    out_channels: int,
    size: int,
    *,
    turns: bool = False,
    reads: Field = "regular",
    gives: Field = "regular",
) -> nn.Module:
    """A convolution whose weights are still unset, so that no global generator draws them."""
    if turns:
        return QuarterTurnConvolution(in_channels, out_channels, size, reads=reads, gives=gives)
    convolution: nn.Conv2d = nn.utils.skip_init(
        nn.Conv2d, in_channels, out_channels, size, padding=size // 2
    )
    return convolution


def shrunk(x: Tensor, stride: int, *, turns: bool) -> Tensor:
    """Every `stride`-th pixel of maps whose channels lie last; means where the features turn."""
    if stride == 1:
        return x
    if turns:
        return functional.avg_pool2d(x, stride)  # every second pixel turns into another one
    # In place of convolutions with a stride: for fewer than 16 channels stored last, their
    # weight gradient writes out of bounds (uxlfoundation/oneDNN issue 6035, torch 2.13).
    return x[:, :, ::stride, ::stride].contiguous(memory_format=torch.channels_last)


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def receptive_span(start: int, stop: int, *, equivariant: bool = False) -> tuple[int, int]:
    """Input rows [start, stop) on which output rows [start, stop) of a `ResNet43` depend.

    An `equivariant` one takes means of two rows where others take the first of two. The result may
    reach outside of the image, where the network sees its own zero padding.

    Examples:
        >>> receptive_span(160, 161)
        (89, 224)
    """
    first, last = start, stop - 1
    for _ in range(3):  # the three stages after an interpolation: two 3x3 convolutions, then twice
        first, last = (first - 2) - 1, (last + 2) + 1
        first, last = first // 2, last // 2
    first, last = first - 4, last + 4  # the stages of 512 and 256 channels at 1/8
    for _ in range(3):  # every second pixel, then two 3x3 convolutions
        first, last = 2 * first - 2, 2 * last + 2 + int(equivariant)
    return first - 1, last + 2
