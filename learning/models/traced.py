"""Traced: which part of a cable to bring to its place, by where the cable leads in both masks.

Both masks are traced from end to end (`warp_deform.tasks.strand_trace`), the goal's in the sense in
which it lies closer. So every point of the cable has a place of its own, and what is left to learn
is which of a few points to take next: the worst placed one is often not the best. A small network
along the cable says so. It sees nothing that depends on where in the picture the cable lies or how
it is turned, and what it says is the same for the mirror image, and whichever end comes first. The
place is the point's own; nothing is learnt of it.

A network over pictures has to find which point belongs where, across the whole picture, before it
can weigh the picks: docs/distillation.md has what the Goal-Split agent makes of the same task.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE
from warp_deform.tasks.strand_trace import trace_strand

from .transporter import Picture, PixelActions

__all__ = [
    "LEVEL",
    "WAYS",
    "Traced",
    "TracedBatch",
    "TracedConfig",
    "TracedLosses",
    "features",
    "matched_traces",
    "turned_over",
]

_UNIT = 50.0
"""Distances are seen in this unit [px], about 10 cm."""
_GAP, _APART = 30.0, 12
"""Strands beside a point are seen up to this distance [px]; so many points along the cable, which
are 32 px of it, are the same strand."""
_ENDS = 2
"""Points from an end that are not taken: half a pad then holds the cable."""
_DOT = 4.0
"""Radius of a pick in a picture [px]."""
_DILATIONS = (1, 2, 4, 8, 8)
_ALONG, _ACROSS, _SINE, _CHANNELS = 0, 1, 6, 9
LEVEL = 127
"""Above it a level of a mask is cable."""
WAYS = ((False, False), (False, True), (True, False), (True, True))
"""What a cable may be shown as: mirrored or not, read from its other end or not."""


@dataclass(frozen=True, kw_only=True)
class TracedConfig:
    """Sizes of a Traced agent."""

    points: int = 91
    """Along the cable; odd, so that an odd number of grips is the same from either end."""
    grips: int = 15
    """Points that may be taken, spread evenly."""
    channels: int = 48
    """Of the network's features."""
    members: int = 3
    """Networks, which learn from the same batches and whose probabilities are averaged."""
    lifts: tuple[float, ...] = (0.05,)
    """Lift of the task's stage [m]; several there must not be."""

    def __post_init__(self) -> None:
        for name, least, most in (("points", 16, 1000), ("grips", 2, self.points - 2 * _ENDS),
                                  ("channels", 1, 1024), ("members", 1, 64)):  # fmt: skip
            if not least <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: {least} to {most} are possible, got {getattr(self, name)}"
                )
        if len(self.lifts) != 1:
            raise InputError(f"lifts: one is needed, got {list(self.lifts)}")

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a picture [pixels]."""
        return SHAPE

    @property
    def taken(self) -> np.ndarray:
        """The points that may be taken, (grips,) int."""
        return np.round(np.linspace(_ENDS, self.points - 1 - _ENDS, self.grips)).astype(int)

    def to_camera(self, pixel: np.ndarray) -> np.ndarray:
        """Pixels as they are."""
        return np.asarray(pixel, dtype=float)


class TracedBatch(NamedTuple):
    """Features (B, 9, points) float32 of traced cables, and which grip was taken, (B,) int64."""

    features: Tensor
    grip: Tensor


class TracedLosses(NamedTuple):
    """Cross entropy [nat] of the grips, the members' mean."""

    pick: Tensor

    def total(self) -> Tensor:
        """The same."""
        return self.pick


class Traced(nn.Module):
    """Which grip to bring to its place.

    Args:
        config: sizes
        seed: of the initial weights
    """

    name: ClassVar[str] = "traced"
    sees: ClassVar[Literal["pictures", "traces", "state"]] = "traces"
    pictures: ClassVar[int] = 2

    def __init__(self, config: TracedConfig, *, seed: int) -> None:
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.members = nn.ModuleList(
            [_Network(config.channels, generator) for _ in range(config.members)]
        )

    def image(self, current: Picture, goal: Picture | None = None) -> Tensor:
        """Both masks, (2, H, W) bool.

        Raises:
            InputError: the goal is missing.
        """
        if goal is None:
            raise InputError(f"{self.name}: a goal picture is needed")
        return torch.from_numpy(np.stack([each[0][..., 0] > LEVEL for each in (current, goal)]))

    def forward(self, batch: TracedBatch) -> TracedLosses:
        """Loss of a batch."""
        losses = [
            functional.cross_entropy(each, batch.grip) for each in self.logits(batch.features)
        ]
        return TracedLosses(torch.stack(losses).mean())

    def logits(self, seen: Tensor) -> Tensor:
        """What every member says of features (B, 9, points): (members, B, grips)."""
        taken = torch.from_numpy(self.config.taken).to(seen.device)
        return torch.stack([member(seen)[:, taken] for member in self.members])

    @torch.no_grad()
    def probabilities(self, now: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """How probable every grip is (grips,) float64, for matched traces (points, 2) [px].

        The mean over members, and over the cable as it is, read from its other end, and mirrored.
        """
        seen = torch.from_numpy(features(now, wanted))[None].to(next(self.parameters()).device)
        each = [self.logits(turned_over(seen, *way)).softmax(dim=2).mean(dim=0)[0] for way in WAYS]
        ahead = [p.flip(0) if back else p for p, (_, back) in zip(each, WAYS, strict=True)]
        return np.asarray(torch.stack(ahead).double().mean(dim=0).cpu().numpy())

    def heat(
        self, mask: np.ndarray, goal: np.ndarray, pick: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pictures (H, W) float32 of how probable picks are in masks (H, W), and of a pick's place.

        Both are 0 where a mask shows no cable.

        Args:
            pick: row and column [px]; the place is that of the grip next to it
        """
        maps = np.zeros((2, *SHAPE), np.float32)
        traces = matched_traces(mask, goal, self.config.points)
        if traces is not None:
            now, wanted = (each[self.config.taken] for each in traces)
            probable = self.probabilities(*traces)
            for row, column, share in zip(*now.T, probable, strict=True):
                _dot(maps[0], row, column, share)
            row, column = wanted[np.linalg.norm(now - pick, axis=1).argmin()]
            _dot(maps[1], row, column, 1.0)
        return maps[0], maps[1]

    def act(self, image: Tensor, *, avoid: Tensor | None = None) -> PixelActions:
        """The most probable pick and its place, for masks (B, 2, H, W).

        What is too small to be traced is brought to the middle of the goal's cable.

        Args:
            avoid: (B, H, W) bool, pixels that are not to be picked, unless there is no other grip

        Raises:
            InputError: the goal's mask shows no cable.
        """
        picks, places = [], []
        for k, (mask, goal) in enumerate(image.cpu().numpy().astype(bool)):
            traces = matched_traces(mask, goal, self.config.points)
            if traces is None:
                picks.append(_middle(mask))
                places.append(_middle_of_cable(goal, self.config.points))
                continue
            now, wanted = (each[self.config.taken] for each in traces)
            probable = self.probabilities(*traces)
            if avoid is not None:
                rows, columns = np.clip(np.rint(now).astype(int), 0, np.array(SHAPE) - 1).T
                barred = avoid[k].cpu().numpy()[rows, columns]
                probable = np.where(barred & ~barred.all(), -1.0, probable)
            grip = int(probable.argmax())
            picks.append(now[grip])
            places.append(wanted[grip])
        count = len(picks)
        return PixelActions(
            np.array(picks), np.array(places), np.zeros(count), np.full(count, self.config.lifts[0])
        )


class _Network(nn.Module):
    """Features (B, 9, points) -> a logit a point (B, points)."""

    def __init__(self, channels: int, generator: torch.Generator) -> None:
        super().__init__()
        first = nn.Conv1d(_CHANNELS, channels, 5, padding=2)
        wide = [nn.Conv1d(channels, channels, 5, padding=2 * k, dilation=k) for k in _DILATIONS]
        self.layers = nn.ModuleList([first, *wide])
        self.out = nn.Conv1d(2 * channels, 1, 1)
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
        logits: Tensor = self.out(torch.cat([x, whole], dim=1))[:, 0]
        return logits


def matched_traces(
    mask: np.ndarray, goal: np.ndarray, points: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (points, 2) [px] along the cable of a mask, and where they belong.

    The goal's begin at the end that brings them closer, on the average. None where a mask shows no
    cable.
    """
    now, wanted = trace_strand(mask, points), trace_strand(goal, points)
    if now is None or wanted is None:
        return None
    ways = (wanted, wanted[::-1])
    return now, min(ways, key=lambda way: float(np.linalg.norm(now - way, axis=1).mean()))


def features(now: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """What the network sees of points (n, 2) [px] and where they belong, (9, n) float32.

    The way to its place along the cable and across it, the latter's size, its length, the mean
    length; cosine and sine of the turn of the cable there; how far along; the gap to other strands.
    """
    tangent, turned = _tangents(now), _tangents(wanted)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    way = (wanted - now) / _UNIT
    along, across = (way * tangent).sum(axis=1), (way * normal).sum(axis=1)
    length = np.linalg.norm(way, axis=1)
    index = np.arange(len(now))
    apart = np.linalg.norm(now[:, None] - now[None], axis=2)
    apart[np.abs(index[:, None] - index) <= _APART] = np.inf
    rows = [
        along,
        across,
        np.abs(across),
        length,
        np.full(len(now), length.mean()),
        (turned * tangent).sum(axis=1),
        (turned * normal).sum(axis=1),
        np.abs(np.linspace(-1.0, 1.0, len(now))),
        np.minimum(apart.min(axis=1), _GAP) / _GAP,
    ]
    return np.stack(rows).astype(np.float32)


def turned_over(seen: Tensor, mirror: bool, back: bool) -> Tensor:
    """Features (B, 9, points) of the mirror image, or of the cable read from its other end."""
    sign = seen.new_ones(_CHANNELS)
    if mirror:
        sign[[_ACROSS, _SINE]] *= -1
    if back:
        sign[[_ALONG, _ACROSS]] *= -1
    shown = seen * sign[:, None]
    return shown.flip(2) if back else shown


def _middle(mask: np.ndarray) -> np.ndarray:
    """The middle one of a mask's pixels (2,), or the picture's where it has none."""
    pixels = np.argwhere(mask)
    return np.array(pixels[len(pixels) // 2] if len(pixels) else np.array(SHAPE) // 2, dtype=float)


def _middle_of_cable(goal: np.ndarray, points: int) -> np.ndarray:
    """The point (2,) [px] half way along the cable of a goal's mask."""
    line = trace_strand(goal, points)
    if line is None:
        raise InputError("the goal's mask shows no cable; give a goal that does")
    return np.asarray(line[points // 2])


def _dot(canvas: np.ndarray, row: float, column: float, value: float) -> None:
    """Raise what a picture (H, W) says about a point to a value."""
    rows, columns = np.ogrid[: canvas.shape[0], : canvas.shape[1]]
    near = np.hypot(rows - row, columns - column) < _DOT
    canvas[near] = np.maximum(canvas[near], value)


def _tangents(line: np.ndarray) -> np.ndarray:
    """Unit vectors along a line (n, 2) of two points or more; the mean of two steps either way."""
    index = np.arange(len(line))
    ahead = line[np.minimum(index + 2, len(line) - 1)] - line[np.maximum(index - 2, 0)]
    return ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
