"""Where to place: features of the scene correlated with rotated crops of features around the pick.

Source: Zeng et al., CoRL 2020; Seita et al., ICRA 2021, section on Goal-Conditioned Transporters.
Kept of the original: zero padding of the raw image by half a crop on every side; three feature
channels; kernels padded to odd size and the mean taken over the crop's area; nearest sampling,
whose zeros are zeros of features (crop after the query) or of normalised images (crop before).
Replaced: the correlation goes through FFTs unless `exact=True`; only the crop is sampled, not the
turned map; the query network runs only on the window of the image that its crop depends on. All
three change rounding only.

Ours, and off by default: place logits are scaled (`gain`), the crop weighs more close to the pick
(`focus`), networks see how far the pick is (`mark_pick`), the zeros stand around features in place
of the image (`pad_features`), and features turn with the picture (`NetworkConfig.equivariant`).
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError

from .correlation import correlate_direct, correlate_fft
from .crops import crop_reach, rotated_crops
from .images import normalise
from .resnet import STRIDE, NetworkConfig, ResNet43, receptive_span

__all__ = ["Transport", "frame", "pick_mark"]

_FEATURES = 3
_PICTURES = 2
"""The current one and the goal's."""
_MARK_REACHES = (2.0, 8.0, 32.0)
"""Distances from the pick at which the channels of its mark have fallen to 1/e [pixels]."""
_FOCUS_SPREAD = 1.5
"""What is close to the pick: standard deviation of a Gaussian [pixels]."""


class Transport(nn.Module):
    """Raw images (B, 4 k, H, W) and picked pixels (B, 2) -> place logits (B, R, H, W).

    The i-th of R rotations turns the crop by 2 pi i / R. 19,666,866 parameters for one picture at
    width 1, 29,500,299 with `goal_split`.

    Args:
        pictures: 1, or 2 where the goal's stands below the current one
        goal_split: a third network sees the goal, and its features multiply those of the others,
            which see the current picture, before the crop; else all see what there is, stacked
        config: the networks
        crop: side of the crop around the pick [pixels], 64 at 320 x 160
        crop_before_query: run the query network on rotated crops of the image, as the first
            Transporters did; else rotate and crop its features, as the paper's
        gain: what place logits are multiplied by
        focus: weight of the mean close to the pick, where that over the whole crop weighs 1
        goal_bias: added to the goal's features, which begin near 0; with 1 the goal changes at
            first little, and key and query learn from the first step on
        mark_pick: show the key network, and the goal's, how far every pixel is from the pick
        pad_features: put zeros around features in place of the image's, so that networks see fewer
            pixels: half a crop less on every side
        exact: correlate directly, as the original does
        generator: draws the initial weights

    Raises:
        InputError: options that exclude each other; in `forward`, crops to be turned before the
            query of images whose channels hold pixels side by side.
    """

    def __init__(
        self,
        *,
        pictures: int = 1,
        goal_split: bool = False,
        config: NetworkConfig = NetworkConfig(),  # noqa: B008 (frozen)
        crop: int = 64,
        crop_before_query: bool = False,
        gain: float = 1.0,
        focus: float = 0.0,
        goal_bias: float = 0.0,
        mark_pick: bool = False,
        pad_features: bool = False,
        exact: bool = False,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if goal_split and pictures != _PICTURES:
            raise InputError(f"pictures: Goal-Split sees {_PICTURES}, got {pictures}")
        if goal_split and crop_before_query:
            raise InputError("crop_before_query: Goal-Split multiplies features before it crops")
        self.crop, self.crop_before_query = crop, crop_before_query
        self.gain, self.focus, self.goal_bias = gain, focus, goal_bias
        self.mark_pick, self.pad_features, self.exact = mark_pick, pad_features, exact
        self.config, self.pictures = config, pictures
        marks = len(_MARK_REACHES) if mark_pick else 0
        network = partial(
            ResNet43,
            _FEATURES,
            pictures=1 if goal_split else pictures,
            config=config,
            generator=generator,
        )
        self.key, self.query = network(marks=marks), network()
        self.goal = network(marks=marks) if goal_split else None
        weights = _around_pick(crop, focus=focus, even=config.equivariant)
        self.register_buffer("_weights", weights, persistent=False)

    def forward(self, image: Tensor, pick: Tensor, *, n_rotations: int = 1) -> Tensor:
        """Place logits (B, R, H, W); `pick` (B, 2) int64 row and column within the image."""
        if self.crop_before_query and n_rotations > 1 and self.config.subpixels > 1:
            raise InputError("fine: such crops cannot be turned; set crop_before_query to False")
        pick = pick.cpu()
        centres = pick + self.crop // 2
        crops = partial(rotated_crops, centres=centres, size=self.crop, n_rotations=n_rotations)
        seen = normalise(image if self.pad_features else frame(image, self.crop))
        mark = pick_mark(seen, pick if self.pad_features else centres) if self.mark_pick else None
        factor = torch.ones_like(seen[:, :1])
        if self.goal is not None:
            seen, wanted = seen.chunk(2, dim=1)
            factor = self.goal(wanted, mark) + self.goal_bias
        key = self.key(seen, mark) * factor
        if self.pad_features:
            key = frame(key, self.crop)
        if self.crop_before_query:
            pieces = crops(normalise(frame(image, self.crop)))
            kernels = self.query(pieces.flatten(0, 1)).unflatten(0, pieces.shape[:2])
        elif self.pad_features:
            kernels = crops(frame(self.query(seen) * factor, self.crop))
        else:
            window = _Window(
                seen,
                centres,
                crop=self.crop,
                n_rotations=n_rotations,
                equivariant=self.config.equivariant,
            )
            kernels = crops(
                self.query(window.of(seen)) * window.of(factor),
                origin=window.origin,
                shape=seen.shape[-2:],
            )
        return self.correlated(key, kernels)

    def correlated(self, key: Tensor, kernels: Tensor) -> Tensor:
        """Place logits of framed features (B, 3, H + S, W + S) and crops (B, R, 3, S, S)."""
        correlate = correlate_direct if self.exact else correlate_fft
        return self.gain * correlate(key, kernels * self._weights.to(kernels))


def pick_mark(x: Tensor, pick: Tensor) -> Tensor:
    """How near the pixels of maps (B, C, H, W) are to picks (B, 2): (B, 3, H, W), 1 at the pick."""
    rows, columns = (torch.arange(side, device=x.device) for side in x.shape[-2:])
    down, right = (pick.to(x.device)[:, axis, None] for axis in range(2))
    distance = torch.hypot((rows - down)[:, :, None].to(x), (columns - right)[:, None].to(x))
    return torch.stack([torch.exp(-distance / reach) for reach in _MARK_REACHES], dim=1)


def frame(x: Tensor, crop: int) -> Tensor:
    """Maps with half a crop of zeros around."""
    half = crop // 2
    return functional.pad(x, (half, half, half, half))


def _around_pick(size: int, *, focus: float, even: bool) -> Tensor:
    """Weights (size, size) of a crop's pixels, 1 on the average plus `focus` close to the pick.

    With `even`, nothing in the first row and column, which have no partner across the pick: so the
    crop, too, turns with the picture.
    """
    steps = torch.arange(size) - size // 2
    bell = torch.exp(-(steps**2) / (2 * _FOCUS_SPREAD**2))
    near = bell[:, None] * bell
    weights = 1 + focus * size**2 * near / near.sum()
    if even:
        weights[0] = weights[:, 0] = 0
    return weights


class _Window:
    """The part of a padded image that decides the query's features in the crops of a batch.

    Every picture has a window of the same size, moved to lie within it: kernels of convolutions are
    prepared once per size.
    """

    def __init__(
        self, x: Tensor, centres: Tensor, *, crop: int, n_rotations: int, equivariant: bool
    ) -> None:
        reach = crop_reach(crop, n_rotations)
        needed = partial(_needed, reach=reach, equivariant=equivariant)
        widest = max(needed(phase, phase)[1] for phase in range(STRIDE))
        lowest, highest = centres.min(dim=0).values.tolist(), centres.max(dim=0).values.tolist()
        spans = []
        for length, low, high in zip(x.shape[-2:], lowest, highest, strict=True):
            extent = min(length, _round_up(high - low + widest))
            start = needed(low, high)[0] // STRIDE * STRIDE
            start = max(0, min(start, length - extent))
            spans.append(slice(start, start + extent))
        self.rows, self.columns = spans

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of its first pixel."""
        return self.rows.start, self.columns.start

    def of(self, x: Tensor) -> Tensor:
        """The window of maps (B, C, H, W)."""
        return x[:, :, self.rows, self.columns]


def _needed(low: int, high: int, *, reach: int, equivariant: bool) -> tuple[int, int]:
    """First input row, and number of rows, behind features within `reach` of rows low to high."""
    start, stop = receptive_span(low - reach, high + reach + 1, equivariant=equivariant)
    return start, stop - start


def _round_up(length: int) -> int:
    return -(-length // STRIDE) * STRIDE
