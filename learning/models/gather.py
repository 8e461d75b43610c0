"""All kernels of some convolutions out of all their learnt weights: one gather, and one back.

A learnt weight stands in up to four places of the kernels (quarter_turns.py), or in one. So the
gradient of the learnt weights is a gather of the kernels' gradients, up to four for each weight,
and their sum, always in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from .quarter_turns import QuarterTurnConvolution

__all__ = ["Convolution", "KernelGather"]

Convolution: TypeAlias = nn.Conv2d | QuarterTurnConvolution
"""What holds the weights of a kernel."""


class KernelGather:
    """Which learnt weight stands where in the kernels that are to be computed with.

    Weights are numbered from 1, in the order of `convolutions`; 0 stands for what is always zero.
    Kernels are gathered in the order in which they were added.

    Args:
        convolutions: those that hold the weights
    """

    def __init__(self, convolutions: Sequence[Convolution]) -> None:
        self._convolutions = list(convolutions)
        self._numbers: dict[Convolution, tuple[Tensor, Tensor]] = {}
        count = 0
        for each in self._convolutions:
            numbered = []
            for learnt in (each.weight, each.bias):
                own = torch.arange(1 + count, 1 + count + learnt.numel(), device=learnt.device)
                numbered.append(own.reshape(learnt.shape))
                count += learnt.numel()
            weight, bias = numbered
            if isinstance(each, QuarterTurnConvolution):
                weight, bias = each.whole_kernel(weight), each.whole_bias(bias)
            self._numbers[each] = weight.cpu(), bias.cpu()
        self._count = count
        self._added: list[Tensor] = []
        self._shapes: list[tuple[int, ...]] = []
        self._indices: dict[torch.device, tuple[Tensor, Tensor]] = {}

    def numbers(self, convolution: Convolution) -> tuple[Tensor, Tensor]:
        """Numbers of the weights in a whole kernel (out, C, size, size), and in its bias (out,)."""
        return self._numbers[convolution]

    def __len__(self) -> int:
        """Kernels and biases that were added."""
        return len(self._shapes)

    def add(self, kernel: Tensor) -> None:
        """Add a kernel (out, C, size, size) or a bias (out,) by the numbers of its weights."""
        self._shapes.append(tuple(kernel.shape))
        if kernel.ndim == 4:
            kernel = kernel.permute(0, 2, 3, 1)  # as channels-last convolutions want them
        self._added.append(kernel.flatten())

    def parameters(self) -> Iterator[nn.Parameter]:
        """The learnt weights."""
        for each in self._convolutions:
            yield each.weight
            yield each.bias

    def __call__(self, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """The kernels that were added, in channels-last order, by the weights as they are."""
        parameters = tuple(self.parameters())
        index, back = self._index(parameters[0].device)
        kernels: tuple[Tensor, ...] = _Gather.apply(
            dtype, index, back, tuple(self._shapes), *parameters
        )
        return kernels

    def _index(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """By a kernels' place the weight, and by a weight (at most R) places counted from 1."""
        if device not in self._indices:
            index = torch.cat(self._added)
            order = index.argsort(stable=True)
            times = torch.bincount(index, minlength=self._count + 1)
            first = times.cumsum(0) - times
            back = torch.zeros(int(times[1:].max()), self._count, dtype=torch.int64)
            for k in range(len(back)):
                there = times[1:] > k
                back[k, there] = 1 + order[(first[1:] + k)[there]]
            self._indices[device] = (index.to(device, torch.int32), back.to(device, torch.int32))
        return self._indices[device]


class _Gather(torch.autograd.Function):
    """Learnt weights -> kernels; `index_select` is the fastest gather on a CPU."""

    @staticmethod
    def forward(
        ctx: Any,
        dtype: torch.dtype,
        index: Tensor,
        back: Tensor,
        shapes: tuple[tuple[int, ...], ...],
        *weights: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.shapes, ctx.weights = shapes, [each.shape for each in weights]
        ctx.dtype = weights[0].dtype
        ctx.save_for_backward(back)
        flat = torch.cat([weights[0].new_zeros(1), *(each.flatten() for each in weights)])
        gathered = flat.to(dtype).index_select(0, index)
        parts = gathered.split([math.prod(shape) for shape in shapes])
        return tuple(_kernel(part, shape) for part, shape in zip(parts, shapes, strict=True))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (back,) = ctx.saved_tensors
        parts = [
            (each.permute(0, 2, 3, 1) if each.ndim == 4 else each).reshape(-1) for each in gradients
        ]
        flat = torch.cat([parts[0].new_zeros(1), *parts])
        times, count = back.shape
        found = flat.index_select(0, back.flatten()).view(times, count)
        learnt = found.sum(0, dtype=ctx.dtype)
        own = learnt.split([math.prod(shape) for shape in ctx.weights])
        of_weights = (part.view(shape) for part, shape in zip(own, ctx.weights, strict=True))
        return None, None, None, None, *of_weights


def _kernel(part: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A kernel (out, C, size, size) whose channels lie last, or a bias."""
    if len(shape) == 1:
        return part
    out, channels, *size = shape
    return part.view(out, *size, channels).permute(0, 3, 1, 2)
