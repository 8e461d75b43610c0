"""Convolutions whose maps turn with the picture by quarter turns (the group C4).

Source: Cohen and Welling, Group Equivariant Convolutional Networks, ICML 2016; Huang et al.,
Equivariant Transporter Network, RSS 2022, which shows what it brings to picking and placing.

A regular field is four maps side by side, one per quarter turn: when the picture turns, each of
them turns and takes the next one's place. A plain field only turns. The weights of one map of four
are learnt; those of the other three are the same ones, turned.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError

__all__ = ["TURNS", "Field", "QuarterTurnConvolution"]

Field = Literal["regular", "plain"]
"""Kind of a field."""
TURNS = 4
"""Maps of a regular field: quarter turns in a full one."""


class QuarterTurnConvolution(nn.Module):
    """Maps (B, C, H, W) -> (B, out, H, W), zeros around, so that turned maps give turned ones.

    Args:
        in_channels: all maps counted, four to a regular field
        out_channels: as `in_channels`
        size: side of the kernel [pixels]; 1 where a plain field is returned
        reads: kind of the fields that come in
        gives: kind of the fields that go out
        pictures: that make up the plain fields which come in
        subpixels: the pixels that a pixel of such a picture covers, `subpixels` x `subpixels`, are
            images of their own (`images.image_tensor` with `fine`) and change places when it turns

    Raises:
        InputError: channels that do not make up the fields.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        size: int,
        *,
        reads: Field = "regular",
        gives: Field = "regular",
        pictures: int = 1,
        subpixels: int = 1,
    ) -> None:
        super().__init__()
        for field, channels in ((reads, in_channels), (gives, out_channels)):
            if field == "regular" and channels % TURNS:
                raise InputError(f"channels of quarter turns come in fours, got {channels}")
        images = pictures * subpixels**2
        if reads == "plain" and in_channels % images:
            raise InputError(f"{in_channels} channels do not make up {images} images")
        if gives == "plain" and (reads == "plain" or size != 1):
            raise InputError("plain fields come out of regular ones, by kernels of side 1")
        self.reads, self.gives = reads, gives
        self.size, self.pictures, self.subpixels = size, pictures, subpixels
        self.channels = in_channels, out_channels
        own = out_channels // TURNS if gives == "regular" else out_channels
        read = [in_channels]
        if reads == "regular":  # a plain field reads the four maps alike
            read = [in_channels // TURNS, TURNS if gives == "regular" else 1]
        self.weight = nn.Parameter(torch.zeros(own, *read, size, size))
        self.bias = nn.Parameter(torch.zeros(own))
        if gives == "regular":
            # Where every map finds its weights among the learnt ones, and where those went.
            count = math.prod(self.weight.shape[1:])
            learnt = torch.arange(count).reshape(self.weight[:1].shape)
            places = torch.stack([self._turned(learnt, turn).flatten() for turn in range(TURNS)])
            origins = places.argsort(dim=1) + count * torch.arange(TURNS)[:, None]
            self.register_buffer("places", places.flatten(), persistent=False)
            self.register_buffer("origins", origins.flatten(), persistent=False)

    def draw(self, generator: torch.Generator) -> None:
        """Initial weights: Glorot-uniform by the channels that meet, biases zero.

        A plain field out of a regular one is a sum over four maps that resemble each other: its
        weights are half as large.
        """
        bound = math.sqrt(6 / (self.size**2 * sum(self.channels)))
        if (self.reads, self.gives) == ("regular", "plain"):
            bound /= math.sqrt(TURNS)
        nn.init.uniform_(self.weight, -bound, bound, generator=generator)
        nn.init.zeros_(self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, out, H, W) of a map (B, C, H, W)."""
        bias = self.whole_bias(self.bias)
        return functional.conv2d(x, self.kernel(), bias, padding=self.size // 2)

    def kernel(self) -> Tensor:
        """The whole kernel (out, C, size, size), with the turned copies of what is learnt."""
        return self.whole_kernel(self.weight)

    def whole_kernel(self, weight: Tensor) -> Tensor:
        """As `kernel`, of weights shaped as the learnt ones, or of their numbers."""
        if self.gives == "plain":
            return weight.expand(-1, -1, TURNS, -1, -1).flatten(1, 2)
        whole: Tensor = _Turned.apply(weight.flatten(1), self.places, self.origins)
        return whole.reshape(self.channels[1], self.channels[0], self.size, self.size)

    def whole_bias(self, bias: Tensor) -> Tensor:
        """Bias (out,) of one shaped as the learnt one."""
        if self.gives == "plain":
            return bias
        return bias[:, None].expand(-1, TURNS).flatten()

    def _turned(self, weight: Tensor, turn: int) -> Tensor:
        """Learnt weights (n, ...) as the map of a field reads them that is `turn` turns on."""
        if self.reads == "regular":
            moved = weight.roll(turn, dims=2).flatten(1, 2)
            return moved.rot90(turn, dims=(-2, -1))
        own, side, sub = len(weight), self.size, self.subpixels
        fine = weight.reshape(own, self.pictures, sub, sub, -1, side, side)
        fine = fine.permute(0, 1, 4, 5, 2, 6, 3).flatten(5, 6).flatten(3, 4)
        fine = fine.rot90(turn, dims=(-2, -1)).unflatten(4, (side, sub)).unflatten(3, (side, sub))
        return fine.permute(0, 1, 4, 6, 2, 3, 5).reshape(weight.shape)


class _Turned(torch.autograd.Function):
    """Weights (n, k) -> (n, TURNS k), each map's in its order; one gather, and one back.

    Rolling, turning and stacking them took a quarter of a training step of `fast`; `index_select`
    is several times faster here than an index in brackets.
    """

    @staticmethod
    def forward(ctx: Any, weight: Tensor, places: Tensor, origins: Tensor) -> Tensor:
        ctx.save_for_backward(origins)
        return weight.index_select(1, places)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (origins,) = ctx.saved_tensors
        back = gradient.index_select(1, origins).unflatten(1, (TURNS, -1))
        total = back[:, TURNS - 1]
        for turn in reversed(range(TURNS - 1)):
            total = total + back[:, turn]
        return total, None, None
