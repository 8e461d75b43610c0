"""Where to place: features of the scene correlated with rotated crops of features around the pick.

Source: Zeng et al., CoRL 2020; Seita et al., ICRA 2021, section on Goal-Conditioned Transporters.
Kept of the original: zero padding of the raw image by half a crop on every side; three feature
channels; kernels padded to odd size and the mean taken over the crop's area; nearest sampling,
whose zeros are zeros of features (crop after the query) or of normalised images (crop before).
Replaced: the correlation goes through FFTs unless `exact=True`; only the crop is sampled, not the
turned map; the query network runs only on the window of the image that its crop depends on. All
three change rounding only.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from .correlation import correlate_direct, correlate_fft
from .crops import crop_reach, rotated_crops
from .images import normalise
from .resnet import STRIDE, NetworkConfig, ResNet43, receptive_span

__all__ = ["Transport", "TransportGoalSplit"]

_FEATURES = 3
_MARK_REACHES = (2.0, 8.0, 32.0)
"""Distances from the pick at which the channels of its mark have fallen to 1/e [pixels]."""
_FOCUS_SPREAD = 1.5
"""What is close to the pick: standard deviation of a Gaussian [pixels]."""


class Transport(nn.Module):
    """Raw images (B, 4 k, H, W) and picked pixels (B, 2) -> place logits (B, R, H, W).

    The i-th of R rotations turns the crop by 2 pi i / R. 19,666,866 parameters for one picture at
    width 1.

    Args:
        pictures: 1, or 2 where the goal is stacked below the current one
        config: the networks
        crop: side of the crop around the pick [pixels], 64 at 320 x 160
        crop_before_query: run the query network on rotated crops of the image, as the first
            Transporters did; else rotate and crop its features, as the paper's
        gain: what place logits are multiplied by
        focus: weight of the mean close to the pick, where that over the whole crop weighs 1
        mark_pick: show the key network, and the goal's, how far every pixel is from the pick
        pad_features: put zeros around features in place of the image's, so that networks see fewer
            pixels: half a crop less on every side
        exact: correlate directly, as the original does
        generator: draws the initial weights
    """

    def __init__(
        self,
        *,
        pictures: int = 1,
        config: NetworkConfig = NetworkConfig(),  # noqa: B008 (frozen)
        crop: int = 64,
        crop_before_query: bool = False,
        gain: float = 1.0,
        focus: float = 0.0,
        mark_pick: bool = False,
        pad_features: bool = False,
        exact: bool = False,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.crop = crop
        self.crop_before_query = crop_before_query
        self.gain, self.focus = gain, focus
        self.mark_pick, self.pad_features, self.exact = mark_pick, pad_features, exact
        self.equivariant = config.equivariant
        marks = len(_MARK_REACHES) if mark_pick else 0
        self.key, self.query = (
            ResNet43(_FEATURES, pictures=pictures, config=config, marks=each, generator=generator)
            for each in (marks, 0)
        )

    def forward(self, image: Tensor, pick: Tensor, *, n_rotations: int = 1) -> Tensor:
        """Place logits (B, R, H, W); `pick` (B, 2) int64 row and column within the image."""
        x, centres = _pad(image, pick, self.crop)
        seen = normalise(image) if self.pad_features else x
        mark = _mark(seen, pick if self.pad_features else centres) if self.mark_pick else None
        key = self.key(seen, mark)
        if self.pad_features:
            key = _framed(key, self.crop)
        if self.crop_before_query:
            crops = rotated_crops(x, centres, size=self.crop, n_rotations=n_rotations)
            kernels = self.query(crops.flatten(0, 1)).unflatten(0, crops.shape[:2])
        elif self.pad_features:
            query = _framed(self.query(seen), self.crop)
            kernels = rotated_crops(query, centres, size=self.crop, n_rotations=n_rotations)
        else:
            window = _Window(
                x, centres, crop=self.crop, n_rotations=n_rotations, equivariant=self.equivariant
            )
            kernels = window.crops(self.query(window.of(x)))
        return _correlate(key, kernels, gain=self.gain, focus=self.focus, exact=self.exact)


class TransportGoalSplit(nn.Module):
    """Raw images (B, 8 k, H, W), current and goal, and picks (B, 2) -> place logits (B, R, H, W).

    A third network sees the goal; its features multiply those of key and query before the crop,
    so the kernel holds the goal's features at the pick. The crop is always after the query.
    29,500,299 parameters at width 1. Arguments as of `Transport`, and

        goal_bias: added to the goal's features, which begin near 0; with 1 the goal changes at
            first little, and key and query learn from the first step on
    """

    def __init__(
        self,
        *,
        config: NetworkConfig = NetworkConfig(),  # noqa: B008 (frozen)
        crop: int = 64,
        gain: float = 1.0,
        focus: float = 0.0,
        goal_bias: float = 0.0,
        mark_pick: bool = False,
        pad_features: bool = False,
        exact: bool = False,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.crop = crop
        self.gain, self.focus, self.goal_bias = gain, focus, goal_bias
        self.mark_pick, self.pad_features, self.exact = mark_pick, pad_features, exact
        self.equivariant = config.equivariant
        marks = len(_MARK_REACHES) if mark_pick else 0
        self.key, self.query, self.goal = (
            ResNet43(_FEATURES, config=config, marks=each, generator=generator)
            for each in (marks, 0, marks)
        )

    def forward(self, image: Tensor, pick: Tensor, *, n_rotations: int = 1) -> Tensor:
        """Place logits (B, R, H, W); `pick` (B, 2) int64 row and column within the image."""
        before, after = image.chunk(2, dim=1)
        current, centres = _pad(before, pick, self.crop)
        if self.pad_features:
            current = normalise(before)
        wanted = normalise(after) if self.pad_features else _pad(after, pick, self.crop)[0]
        mark = _mark(current, pick if self.pad_features else centres) if self.mark_pick else None
        goal = self.goal(wanted, mark)
        goal = goal + self.goal_bias if self.goal_bias else goal
        key = self.key(current, mark) * goal
        if self.pad_features:
            key = _framed(key, self.crop)
            query = _framed(self.query(current) * goal, self.crop)
            kernels = rotated_crops(query, centres, size=self.crop, n_rotations=n_rotations)
        else:
            window = _Window(
                current,
                centres,
                crop=self.crop,
                n_rotations=n_rotations,
                equivariant=self.equivariant,
            )
            kernels = window.crops(self.query(window.of(current)) * window.of(goal))
        return _correlate(key, kernels, gain=self.gain, focus=self.focus, exact=self.exact)


def _pad(image: Tensor, pick: Tensor, crop: int) -> tuple[Tensor, Tensor]:
    """The network's input, padded by half a crop a side, and the picks in it (on the CPU)."""
    return normalise(_framed(image, crop)), pick.cpu() + crop // 2


def _mark(x: Tensor, pick: Tensor) -> Tensor:
    """How near the pixels of maps (B, C, H, W) are to picks (B, 2): (B, 3, H, W), 1 at the pick."""
    rows, columns = (torch.arange(side, device=x.device) for side in x.shape[-2:])
    down, right = (pick.to(x.device)[:, axis, None] for axis in range(2))
    distance = torch.hypot((rows - down)[:, :, None].float(), (columns - right)[:, None].float())
    return torch.stack([torch.exp(-distance / reach) for reach in _MARK_REACHES], dim=1)


def _framed(x: Tensor, crop: int) -> Tensor:
    """Maps with half a crop of zeros around."""
    half = crop // 2
    return functional.pad(x, (half, half, half, half))


def _correlate(key: Tensor, kernels: Tensor, *, gain: float, focus: float, exact: bool) -> Tensor:
    if focus:
        kernels = kernels * _around_pick(kernels.shape[-1], focus).to(kernels.device)
    logits = (correlate_direct if exact else correlate_fft)(key, kernels)
    return logits if gain == 1.0 else gain * logits


def _around_pick(size: int, focus: float) -> Tensor:
    """Weights (size, size) of a crop's pixels, 1 on the average plus `focus` close to the pick."""
    steps = torch.arange(size) - size // 2
    bell = torch.exp(-(steps**2) / (2 * _FOCUS_SPREAD**2))
    near = bell[:, None] * bell
    return 1 + focus * size**2 * near / near.sum()


class _Window:
    """The part of a padded image that decides the query's features in the crops of a batch.

    Every picture has a window of the same size, moved to lie within it: kernels of convolutions are
    prepared once per size.
    """

    def __init__(
        self, x: Tensor, centres: Tensor, *, crop: int, n_rotations: int, equivariant: bool
    ) -> None:
        self.size, self.n_rotations = crop, n_rotations
        self.shape = (x.shape[-2], x.shape[-1])
        reach = crop_reach(crop, n_rotations)
        needed = partial(_needed, reach=reach, equivariant=equivariant)
        widest = max(needed(phase, phase)[1] for phase in range(STRIDE))
        lowest, highest = centres.min(dim=0).values.tolist(), centres.max(dim=0).values.tolist()
        spans = []
        for length, low, high in zip(self.shape, lowest, highest, strict=True):
            extent = min(length, _round_up(high - low + widest + STRIDE))
            start = needed(low, high)[0] // STRIDE * STRIDE
            start = max(0, min(start, length - extent))
            spans.append(slice(start, start + extent))
        self.rows, self.columns = spans
        self.centres = centres

    def of(self, x: Tensor) -> Tensor:
        """The window of maps (B, C, H, W)."""
        return x[:, :, self.rows, self.columns]

    def crops(self, features: Tensor) -> Tensor:
        """Rotated crops (B, R, C, S, S) of features of the window."""
        return rotated_crops(
            features,
            self.centres,
            size=self.size,
            n_rotations=self.n_rotations,
            origin=(self.rows.start, self.columns.start),
            shape=self.shape,
        )


def _needed(low: int, high: int, *, reach: int, equivariant: bool) -> tuple[int, int]:
    """First input row, and number of rows, behind features within `reach` of rows low to high."""
    start, stop = receptive_span(low - reach, high + reach + 1, equivariant=equivariant)
    return start, stop - start


def _round_up(length: int) -> int:
    return -(-length // STRIDE) * STRIDE
