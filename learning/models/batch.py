"""Labelled images, and how wrong heat maps are about them."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from warp_deform.errors import InputError

__all__ = ["Batch", "Labels", "Losses", "labels_of", "losses_of"]


class Batch(NamedTuple):
    """Labelled images, in network pixels.

    Attributes:
        image: (B, 4 k, H, W) float32, raw (see `image_tensor`): the current picture, then the
            goal's
        pick: (B, 2) int64, row and column
        place: (B, 2) int64, row and column
        theta: (B,) float, pick yaw minus place yaw [rad]
        lift: (B,) int64, index into the configuration's lifts
    """

    image: Tensor
    pick: Tensor
    place: Tensor
    theta: Tensor
    lift: Tensor


class Labels(NamedTuple):
    """What maps and choices of a batch should say, (B,) int64 each.

    Attributes:
        pick: pixel of the pick, counted row by row
        place: the same in a stack of maps, one a rotation
        lift: index of the lift
    """

    pick: Tensor
    place: Tensor
    lift: Tensor


class Losses(NamedTuple):
    """Cross entropies [nat], means over a batch; no two share a parameter.

    Their sum may therefore be minimised at once. `lift` is 0 where there is one lift.
    """

    attention: Tensor
    transport: Tensor
    lift: Tensor

    def total(self) -> Tensor:
        """Their sum."""
        return self.attention + self.transport + self.lift


def labels_of(batch: Batch, shape: tuple[int, int], *, n_rotations: int) -> Labels:
    """Labels of a batch whose pictures have a shape (H, W).

    Raises:
        InputError: a labelled pixel outside of it.
    """
    picks, places = _flat("pick", batch.pick, shape), _flat("place", batch.place, shape)
    # Halves go to even, as in the original.
    turns = torch.round(batch.theta.double() / (2 * math.pi / n_rotations)).long()
    return Labels(picks, turns % n_rotations * math.prod(shape) + places, batch.lift)


def losses_of(heat: Tensor, logits: Tensor, lifts: Tensor | None, labels: Labels) -> Losses:
    """Losses of pick logits (B, H, W), place logits (B, R, H, W) and lift logits (B, n)."""
    attention = functional.cross_entropy(heat.flatten(1), labels.pick)
    transport = functional.cross_entropy(logits.flatten(1), labels.place)
    if lifts is None:
        return Losses(attention, transport, attention.new_zeros(()))
    return Losses(attention, transport, functional.cross_entropy(lifts, labels.lift))


def _flat(name: str, pixel: Tensor, shape: tuple[int, int]) -> Tensor:
    """Index (B,) of pixels (B, 2) in a flattened image."""
    limit = torch.tensor(shape, device=pixel.device)
    outside = ((pixel < 0) | (pixel >= limit)).any(dim=1)
    if outside.any():
        raise InputError(
            f"{name}: pixel {pixel[outside][0].tolist()} lies outside of {shape[0]} x {shape[1]}"
        )
    return pixel[:, 0] * shape[1] + pixel[:, 1]
