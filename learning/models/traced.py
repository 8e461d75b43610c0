"""Traced: foresees where a traced cable will lie, and takes the point that brings it closest.

Both masks are traced from end to end (`warp_deform.tasks.strand_trace`), the goal's in the sense in
which it lies closer. So every point of the cable has a place of its own. What is learnt is where
the whole cable lies after a point was carried (`learning.models.cable_model`): from what was
done and seen next, whoever did it, well or badly. To act, it foresees what becomes of the cable
when each of a few points is brought to its place, and takes what leads to the greatest value: how
far the masks overlap, how close every point is to its place, and that the cable is not bent
otherwise than the goal's, for a cable that folded up hides how it lies.

Sources: model predictive control with a learnt model; of cables, see `learning.models.cable_model`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.metrics import chord_error, mask_iou
from warp_deform.tasks.strand_trace import trace_strand

from .cable_model import CableNetwork, after_moves
from .transporter import Picture, PixelActions

__all__ = [
    "LEVEL",
    "Traced",
    "TracedBatch",
    "TracedConfig",
    "TracedLosses",
    "closer_way",
    "matched_traces",
]

_ENDS = 1
"""Points from an end that are not taken: half a pad then holds the cable."""
_CHORD = 0.075
"""Of cable that a chord bridges, more than a kink [m]."""
_SOLVED, _SURE = 0.6, 0.03
"""What it is worth to be done, and by so much the overlap should exceed what is needed."""
_LINKS = 2.5
"""Weight of errors in the steps from point to point, beside those of the points."""
_SHARP = 0.1
"""Values that differ by so much differ e times in a picture of them."""
_DOT = 4.0
"""Radius of a pick in a picture [px]."""
LEVEL = 127
"""Above it a level of a mask is cable."""


@dataclass(frozen=True, kw_only=True)
class TracedConfig:
    """Sizes of a Traced agent."""

    points: int = 45
    """Along the cable."""
    grips: int = 15
    """Points that may be taken, spread evenly."""
    channels: int = 64
    """Of a network's features."""
    members: int = 2
    """Networks, which learn from the same batches and whose answers are averaged."""
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
    """Moves as they are seen (B, 8, points) float32, and how far points went (B, 2, points)."""

    seen: Tensor
    moved: Tensor


class TracedLosses(NamedTuple):
    """Mean errors of where points go, and of the steps between them, in units of 50 pixels."""

    points: Tensor
    links: Tensor

    def total(self) -> Tensor:
        """Their weighted sum."""
        return self.points + _LINKS * self.links


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
        self._task = CableMaskGoal()
        generator = torch.Generator().manual_seed(seed)
        self.members = nn.ModuleList(
            [CableNetwork(config.channels, generator) for _ in range(config.members)]
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
        """Losses of a batch, the members' mean."""
        wrong = torch.stack([member(batch.seen) for member in self.members]) - batch.moved
        return TracedLosses(wrong.abs().mean(), wrong.diff(dim=3).abs().mean())

    def values(self, now: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """How good it is to bring each grip to its place (grips,), for traces (points, 2) [px]."""
        goal = self._drawn(wanted)
        return np.array([self._value(line, wanted, goal) for line in self.foreseen(now, wanted)])

    def foreseen(self, now: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Where the cable lies after each grip was brought to its place, (grips, points, 2) [px].

        Args:
            now: points along the cable (points, 2) [px]
            wanted: their places (points, 2) [px]
        """
        taken = self.config.taken
        lines = np.broadcast_to(now, (len(taken), *now.shape))
        return after_moves(self.members, lines, now[taken], wanted[taken])

    def heat(
        self, mask: np.ndarray, goal: np.ndarray, pick: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pictures (H, W) float32 of how good picks are in masks (H, W), and of a pick's place.

        The best one has 1. Both are 0 where a mask shows no cable.

        Args:
            pick: row and column [px]; the place is that of the grip next to it
        """
        maps = np.zeros((2, *SHAPE), np.float32)
        traces = matched_traces(mask, goal, self.config.points)
        if traces is not None:
            now, wanted = (each[self.config.taken] for each in traces)
            values = self.values(*traces)
            for row, column, lead in zip(*now.T, values - values.max(), strict=True):
                _dot(maps[0], row, column, np.exp(lead / _SHARP))
            row, column = wanted[np.linalg.norm(now - pick, axis=1).argmin()]
            _dot(maps[1], row, column, 1.0)
        return maps[0], maps[1]

    def act(self, image: Tensor, *, avoid: Tensor | None = None) -> PixelActions:
        """The best pick and its place, for masks (B, 2, H, W).

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
            values = self.values(*traces)
            if avoid is not None:
                rows, columns = np.clip(np.rint(now).astype(int), 0, np.array(SHAPE) - 1).T
                barred = avoid[k].cpu().numpy()[rows, columns]
                values = np.where(barred & ~barred.all(), -np.inf, values)
            grip = int(values.argmax())
            picks.append(now[grip])
            places.append(wanted[grip])
        count = len(picks)
        return PixelActions(
            np.array(picks), np.array(places), np.zeros(count), np.full(count, self.config.lifts[0])
        )

    def _value(self, line: np.ndarray, wanted: np.ndarray, goal: np.ndarray) -> float:
        """How good it is that a cable lies at (points, 2) [px], for a goal and its mask."""
        length = self._task.cable.length / self._task.grid.pixel_size
        steps = self.config.points - 1
        links = max(1, round(_CHORD / self._task.cable.length * steps))
        overlap = mask_iou(self._drawn(line), goal)
        cost = min(
            float(np.linalg.norm(line - way, axis=1).mean()) / length
            + chord_error(line, way, links=links, spacing=length / steps)
            for way in (wanted, wanted[::-1])
        )
        solved = 1 / (1 + np.exp((self._task.success_score + _SURE - overlap) / _SURE))
        return overlap - cost + _SOLVED * float(solved)

    def _drawn(self, line: np.ndarray) -> np.ndarray:
        """Mask (H, W) of a cable (points, 2) [px], as thick as the task's."""
        return self._task.mask(self._task.grid.to_world(line))


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
    return now, closer_way(now, wanted)


def closer_way(now: np.ndarray, then: np.ndarray) -> np.ndarray:
    """A line (points, 2), read from the end that brings its points closer to another's."""
    return min((then, then[::-1]), key=lambda way: float(np.linalg.norm(now - way, axis=1).mean()))


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
