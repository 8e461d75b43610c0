"""Choosing the pick: its probability is weighed with how surely its place is known.

The paper takes the most probable pick, then its most probable place. Where a demonstrator might
have picked one of several things, the most probable one is often one that the network cannot tell
where to place. With several `picks`, a pick is worth its probability times the probability that
its thing belongs within two pixels of one place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["Choice", "choose"]

_NEAR = 2
"""Pixels to each side that are about the same pick, and about the same place [network pixels]."""


class Choice(NamedTuple):
    """Where to pick and place.

    Attributes:
        pick: row and column (2,) int64 [network pixels]
        rotation: index of the place's
        place: row and column (2,) int64 [network pixels]
    """

    pick: Tensor
    rotation: int
    place: Tensor


def choose(heat: Tensor, place_logits: Callable[[Tensor], Tensor], *, picks: int) -> Choice:
    """The best pick of several, and its most probable place.

    Probabilities of places are 1 at most, so picks that are less probable than the best one so far
    is worth are not looked at: where the network is sure, one is enough.

    Args:
        heat: pick logits (H, W) on the CPU; -inf where nothing is to be picked, not everywhere
        place_logits: of a pick (2,) the place logits (R, H, W) on the CPU
        picks: how many may be weighed; 1 takes the most probable pick
    """
    everything = torch.logsumexp(heat.flatten(), 0)
    left, columns = heat.clone(), heat.shape[1]
    best, most = None, -math.inf
    for _ in range(picks):
        pick = _pixel(int(left.argmax()), columns)
        row, column = pick.tolist()
        probable = float(left[row, column] - everything)
        if best is not None and probable <= most:
            break
        logits = place_logits(pick)
        worth = probable + _sureness(logits) if picks > 1 else probable
        if best is None or worth > most:
            rotation, flat = divmod(int(logits.argmax()), heat.numel())
            best, most = Choice(pick, rotation, _pixel(flat, columns)), worth
        left[
            max(row - _NEAR, 0) : row + _NEAR + 1, max(column - _NEAR, 0) : column + _NEAR + 1
        ] = -math.inf
    assert best is not None
    return best


def _sureness(logits: Tensor) -> float:
    """Logarithm of the greatest probability within a few pixels of one place, (R, H, W) logits."""
    side = 2 * _NEAR + 1
    likely = logits.flatten().softmax(0).view(logits.shape)
    near = functional.avg_pool2d(likely[None], side, stride=1, padding=_NEAR) * side**2
    return math.log(float(near.max()))


def _pixel(flat: int, columns: int) -> Tensor:
    """Row and column of a pixel, counted row by row."""
    return torch.tensor(divmod(flat, columns))
