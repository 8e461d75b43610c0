"""The block of `resnet.ResNet43` as one node of autograd's graph, for networks side by side.

Nothing is computed twice or copied for the graph's sake: what a block forms in passing is changed
in place, forward and backward. With one network, 1x1 convolutions are products of matrices, whose
rows are pixels: torch's own convolution takes twice the time for maps of 160 x 80 in float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["bottleneck", "pointwise"]

_aten = torch.ops.aten
_STEP, _PAD = [1, 1], [[0, 0], [1, 1]]


def bottleneck(
    x: Tensor,
    lateral: Tensor | None,
    kernels: Sequence[tuple[Tensor, Tensor]],
    *,
    groups: int,
    upsample: bool,
    activate: bool,
) -> Tensor:
    """Map (B, out, H, W) of maps (B, C, H, W) whose channels lie last; see `resnet._Block`.

    Args:
        lateral: joins the bottleneck before its 3x3 convolution
        kernels: 1x1, 3x3, 1x1, and the shortcut's where the block has one, each with its bias
        groups: networks side by side
        upsample: double the map
        activate: end with a ReLU
    """
    flat = [each for pair in kernels for each in pair]
    flat += [None] * (8 - len(flat))
    y: Tensor = _Bottleneck.apply(groups, upsample, activate, x, lateral, *flat)
    return y


def pointwise(x: Tensor, kernel: Tensor, bias: Tensor, *, groups: int) -> Tensor:
    """A 1x1 convolution of maps whose channels lie last."""
    y: Tensor = _Pointwise.apply(groups, x, kernel, bias)
    return y


class _Pointwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, groups: int, x: Tensor, kernel: Tensor, bias: Tensor) -> Tensor:
        ctx.groups = groups
        ctx.save_for_backward(x, kernel)
        return _mix(x, kernel, bias, groups)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, kernel = ctx.saved_tensors
        return None, *_mix_back(_last(gradient), x, kernel, ctx.groups)


class _Bottleneck(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, groups: int, upsample: bool, activate: bool, x: Tensor, lateral: Tensor | None,
        reduce: Tensor, reduce_bias: Tensor, spatial: Tensor, spatial_bias: Tensor,
        expand: Tensor, expand_bias: Tensor, shortcut: Tensor | None, shortcut_bias: Tensor | None,
    ) -> Tensor:  # fmt: skip
        near = _mix(x, reduce, reduce_bias, groups)
        if shortcut is None or shortcut_bias is None:
            past = x
        else:
            past = _mix(x, shortcut, shortcut_bias, groups)
        if upsample:
            near, past = _twice(near), _twice(past)
        if lateral is not None:
            near = near.add_(lateral)
        near = near.clamp_min_(0)
        wide = torch.conv2d(near, spatial, spatial_bias, _STEP, _PAD[1], _STEP, groups)
        wide = wide.clamp_min_(0)
        y = _mix(wide, expand, expand_bias, groups).add_(past)
        if activate:
            y = y.clamp_min_(0)
        ctx.groups, ctx.upsample, ctx.activate = groups, upsample, activate
        ctx.joined = lateral is not None
        ctx.save_for_backward(x, near, wide, y, reduce, spatial, expand, shortcut)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, near, wide, y, reduce, spatial, expand, shortcut = ctx.saved_tensors
        groups, gradient = ctx.groups, _last(gradient)
        if ctx.activate:  # not in place: it may be another node's, too
            gradient = _aten.threshold_backward(gradient, y, 0)
        inner, d_expand, d_expand_bias = _mix_back(gradient, wide, expand, groups)
        inner, d_spatial, d_spatial_bias = _aten.convolution_backward(
            _active(inner, wide), near, spatial, [len(spatial)], _STEP, _PAD[1], _STEP,
            False, [0, 0], groups, [True, True, True],
        )  # fmt: skip
        inner = _active(_last(inner), near)
        lateral, past = inner if ctx.joined else None, gradient
        if ctx.upsample:
            inner, past = _twice_back(inner, x), _twice_back(gradient, x)
        back, d_reduce, d_reduce_bias = _mix_back(inner, x, reduce, groups)
        d_shortcut = d_shortcut_bias = None
        if shortcut is None:
            back = back.add_(past)
        else:
            beside, d_shortcut, d_shortcut_bias = _mix_back(past, x, shortcut, groups)
            back = back.add_(beside)
        return (
            None, None, None, back, lateral, d_reduce, d_reduce_bias, d_spatial, d_spatial_bias,
            d_expand, d_expand_bias, d_shortcut, d_shortcut_bias,
        )  # fmt: skip


def _mix(x: Tensor, kernel: Tensor, bias: Tensor, groups: int) -> Tensor:
    """A 1x1 convolution; dense where the kernel reads all channels."""
    if groups > 1:
        return torch.conv2d(x, kernel, bias, _STEP, _PAD[0], _STEP, x.shape[1] // kernel.shape[1])
    batch, _, height, width = x.shape
    y = torch.addmm(bias, _rows(x), _matrix(kernel).t())
    return y.view(batch, height, width, -1).permute(0, 3, 1, 2)


def _mix_back(
    gradient: Tensor, x: Tensor, kernel: Tensor, groups: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of what a 1x1 convolution reads, of its kernel and of its bias."""
    if groups > 1:
        given = _aten.convolution_backward(
            gradient, x, kernel, [len(kernel)], _STEP, _PAD[0], _STEP,
            False, [0, 0], x.shape[1] // kernel.shape[1], [True, True, True],
        )  # fmt: skip
        return _last(given[0]), given[1], given[2]
    batch, channels, height, width = x.shape
    rows, seen = _rows(gradient), _rows(x)
    back = torch.mm(rows, _matrix(kernel)).view(batch, height, width, channels)
    of_kernel = torch.mm(rows.t(), seen)[:, :, None, None]
    return back.permute(0, 3, 1, 2), of_kernel, rows.sum(0)


def _rows(x: Tensor) -> Tensor:
    """Pixels (B H W, C) of maps (B, C, H, W) whose channels lie last."""
    return x.permute(0, 2, 3, 1).reshape(-1, x.shape[1])


def _matrix(kernel: Tensor) -> Tensor:
    return kernel[:, :, 0, 0]


def _last(x: Tensor) -> Tensor:
    """Maps whose channels lie last."""
    return x.contiguous(memory_format=torch.channels_last)


def _active(gradient: Tensor, y: Tensor) -> Tensor:
    """Zero a gradient, in place, where a ReLU gave zero."""
    kept: Tensor = _aten.threshold_backward.grad_input(gradient, y, 0, grad_input=gradient)
    return kept


def _twice(x: Tensor) -> Tensor:
    """As `torch.nn.functional.interpolate`, bilinear with half-pixel centres."""
    y: Tensor = _aten.upsample_bilinear2d(x, [2 * side for side in x.shape[-2:]], False, 2.0, 2.0)
    return y


def _twice_back(gradient: Tensor, x: Tensor) -> Tensor:
    """Gradient of maps as large as `x`."""
    size = [len(gradient), gradient.shape[1], *x.shape[-2:]]
    given: Tensor = _aten.upsample_bilinear2d_backward(
        gradient, list(gradient.shape[-2:]), size, False, 2.0, 2.0
    )
    return _last(given)
