"""A model of what becomes of a cable when one of its points is carried somewhere, all in pixels.

A network along the cable sees where every point lies from the pick's, the place's direction being
ahead, and says how far each goes. So what it says does not depend on where in the picture the cable
lies or how it is turned; and it is asked in all four ways in which the same cable can be shown,
mirrored or not, read from either end.

Source: of models of rope that are learnt to plan with, Yan et al., "Self-supervised learning of
state estimation for manipulating deformable linear objects", RA-L 2020.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = [
    "WAYS",
    "CableNetwork",
    "after_moves",
    "moved_points",
    "same_way",
    "seen_moves",
    "turned_over",
    "turned_over_points",
]

_UNIT = 50.0
"""Distances are seen and said in this unit [px], about 10 cm."""
_DILATIONS = (1, 2, 4, 8, 4)
_MIRRORED, _REVERSED = [1, 3], [2, 3, 7]
"""Channels that change their sign in the mirror image, and when read from the other end."""
_CHANNELS = 8
WAYS = ((False, False), (False, True), (True, False), (True, True))
"""What a cable may be shown as: mirrored or not, read from its other end or not."""


class CableNetwork(nn.Module):
    """Moves as they are seen (B, 8, points) -> how far every point goes (B, 2, points).

    Args:
        channels: of its features
        generator: of the initial weights
    """

    def __init__(self, channels: int, generator: torch.Generator) -> None:
        super().__init__()
        first = nn.Conv1d(_CHANNELS, channels, 5, padding=2)
        wide = [nn.Conv1d(channels, channels, 5, padding=2 * k, dilation=k) for k in _DILATIONS]
        self.layers = nn.ModuleList([first, *wide])
        self.out = nn.Conv1d(2 * channels, 2, 1)
        for layer in (*self.layers, self.out):
            bound = (layer.in_channels * layer.kernel_size[0]) ** -0.5
            nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator=generator)

    def forward(self, seen: Tensor) -> Tensor:
        first, *wide = self.layers
        x = functional.relu(first(seen))
        for layer in wide:
            x = x + functional.relu(layer(x))
        whole = x.mean(dim=2, keepdim=True).expand_as(x)
        moved: Tensor = self.out(torch.cat([x, whole], dim=1))
        return moved


def _axes(picks: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Of every move (K, 2) -> (K, 2) its own axes, rows of (K, 2, 2): ahead, and to the left."""
    way = places - picks
    length = np.linalg.norm(way, axis=1, keepdims=True)
    ahead = np.where(length > 0, way / np.maximum(length, 1e-9), [1.0, 0.0])
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    return np.stack([ahead, left], axis=1)


def seen_moves(lines: np.ndarray, picks: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Moves of cables as a `CableNetwork` sees them, (K, 8, points) float32.

    Every point's position from the pick and the cable's direction there, ahead and to the left; how
    far the pick is carried; how far along the cable the pick is, twice, near and far; which side.

    Args:
        lines: a cable for each move (K, points, 2) [px]
        picks: (K, 2) [px]; the point of the cable nearest to it is taken
        places: (K, 2) [px]
    """
    axes = _axes(picks, places)
    count, points = lines.shape[:2]
    tangent = np.gradient(lines, axis=1)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=2, keepdims=True), 1e-9)
    position = np.einsum("kij,knj->kin", axes, lines - picks[:, None]) / _UNIT
    direction = np.einsum("kij,knj->kin", axes, tangent)
    taken = np.linalg.norm(lines - picks[:, None], axis=2).argmin(axis=1)
    along = np.arange(points)[None] - taken[:, None]
    far = np.linalg.norm(places - picks, axis=1)[:, None] / _UNIT
    rows = [
        np.broadcast_to(far, (count, points)),
        2 * np.abs(along) / points,
        np.exp(-8 * np.abs(along) / points),
        np.sign(along),
    ]
    return np.concatenate([position, direction, np.stack(rows, axis=1)], axis=1).astype(np.float32)


def turned_over(seen: Tensor, mirror: bool, back: bool) -> Tensor:
    """Moves (B, 8, points) as seen of the mirror image, or of the cable read from its other end."""
    sign = seen.new_ones(_CHANNELS)
    if mirror:
        sign[_MIRRORED] *= -1
    if back:
        sign[_REVERSED] *= -1
    shown = seen * sign[:, None]
    return shown.flip(2) if back else shown


def turned_over_points(moved: Tensor, mirror: bool, back: bool) -> Tensor:
    """How far points go (B, 2, points), of the mirror image, or read from the other end."""
    shown = torch.stack([moved[:, 0], -moved[:, 1]], dim=1) if mirror else moved
    return shown.flip(2) if back else shown


def moved_points(
    lines: np.ndarray, after: np.ndarray, picks: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """How far points went, from lines to others (K, points, 2) [px], as said, (K, 2, points)."""
    moved = np.einsum("kij,knj->kin", _axes(picks, places), after - lines) / _UNIT
    return np.asarray(moved, np.float32)


def same_way(now: np.ndarray, after: np.ndarray, pick: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The line (points, 2) after a move, read from the end from which the one before is.

    Points lie closer to where they lay, and the picked one to its place: an end that is carried
    beyond the other end would fit either way without the latter.
    """
    taken = int(np.linalg.norm(now - pick, axis=1).argmin())

    def far(way: np.ndarray) -> float:
        rest = float(np.linalg.norm(way - now, axis=1).mean())
        return rest + float(np.linalg.norm(way[taken] - place))

    return min((after, after[::-1]), key=far)


@torch.no_grad()
def after_moves(
    members: Sequence[nn.Module] | nn.ModuleList,
    lines: np.ndarray,
    picks: np.ndarray,
    places: np.ndarray,
) -> np.ndarray:
    """Where cables lie after moves, (K, points, 2) [px]: the mean over members and `WAYS`.

    Args:
        lines: a cable for each move (K, points, 2) [px]
        picks: (K, 2) [px]
        places: (K, 2) [px]
    """
    device = next(iter(members[0].parameters())).device
    seen = torch.from_numpy(seen_moves(lines, picks, places)).to(device)
    every = torch.cat([turned_over(seen, *way) for way in WAYS])
    said = torch.stack([member(every) for member in members]).mean(dim=0)
    parts = said.split(len(seen))
    moved = torch.stack(
        [turned_over_points(part, *way) for part, way in zip(parts, WAYS, strict=True)]
    ).mean(0)
    back = np.einsum("kij,kin->knj", _axes(picks, places), moved.double().cpu().numpy())
    return np.asarray(lines + _UNIT * back)
