"""Paths of tips that were recorded at a fixed rate: cut where they hold, walked faster, smoothed.

Source: the smoothing is a penalised spline (Eilers and Marx, "Flexible smoothing with B-splines and
penalties", Statistical Science 1996) of degree 0: a fit with a penalty on squared second
differences.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = [
    "RecordedPath",
    "Stretch",
    "WalkedPath",
    "cut",
    "hats",
    "held_stretches",
    "roughness",
    "walked",
]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Control steps first to last - 1, in which a tip keeps, or keeps free of, one thing.

    Attributes:
        hold: what the actions say of it
        held: particle or body that the tip holds; None twice where there is none
        place: where that was when it was taken (3,) [m]
    """

    first: int
    last: int
    hold: bool
    held: tuple[int | None, int | None] = (None, None)
    place: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class RecordedPath:
    """How a recorded episode was led.

    Attributes:
        targets: where the tip was told to be (T + 1, 4), x, y, z [m], yaw [rad]; first the start
        stretches: that follow one another
    """

    targets: np.ndarray
    stretches: tuple[Stretch, ...]

    @property
    def steps(self) -> int:
        """Control steps T."""
        return len(self.targets) - 1


@dataclass(frozen=True, eq=False)
class WalkedPath:
    """A recorded path that is walked at another pace.

    Attributes:
        targets: (T + 1, 4) as those of `RecordedPath`, but of other T
        stretches: the same ones, of other steps
    """

    targets: np.ndarray
    stretches: tuple[Stretch, ...]

    @property
    def steps(self) -> int:
        """Control steps T."""
        return len(self.targets) - 1

    def stretch_at(self, step: int) -> int:
        """Number of the stretch of a control step."""
        return next(k for k, stretch in enumerate(self.stretches) if step < stretch.last)


def roughness(actions: np.ndarray) -> float:
    """Sum of the squared changes of the moves of actions (T, A), from rest and back to rest.

    The last number of an action, which says whether to hold, does not count.
    """
    moves = np.pad(np.asarray(actions, dtype=float)[:, :-1], ((1, 1), (0, 0)))
    return float((np.diff(moves, axis=0) ** 2).sum())


def walked(
    path: RecordedPath, *, free: float, held: float, smoothing: float, stride: float
) -> WalkedPath:
    """A path that is walked faster, with rounded corners; takes and releases keep their places.

    Args:
        free: how many times as fast a tip goes that holds nothing, 1 or more
        held: the same of one that holds something
        smoothing: weight of squared second differences beside squared deviations; 0: none
        stride: longest way of a control step [m]; nothing gets faster than that
    """
    rows, stretches = [path.targets[:1]], list[Stretch]()
    first = 0
    for stretch in path.stretches:
        part = path.targets[stretch.first : stretch.last + 1]
        faster = _faster(part, held if stretch.hold else free, stride)
        rows.append(faster[1:])
        stretches.append(
            Stretch(first, first + len(faster) - 1, stretch.hold, stretch.held, stretch.place)
        )
        first = stretches[-1].last
    targets = np.concatenate(rows)
    fixed = [0, *(stretch.last for stretch in stretches)]
    return WalkedPath(_smoothed(targets, fixed, smoothing), tuple(stretches))


def _faster(part: np.ndarray, pace: float, stride: float) -> np.ndarray:
    """A polyline (n + 1, 4), one point a step, walked `pace` times as fast."""
    ways = np.linalg.norm(np.diff(part[:, :3], axis=0), axis=1)
    # the slack keeps a step of just the longest way from taking two
    times = np.concatenate([[0.0], np.cumsum(np.maximum(1.0 / pace, ways / stride))])
    count = max(1, int(np.ceil(times[-1] - 1e-3)))
    at = np.linspace(0.0, times[-1], count + 1)
    return np.stack([np.interp(at, times, column) for column in part.T], axis=1)


def _smoothed(targets: np.ndarray, fixed: Sequence[int], weight: float) -> np.ndarray:
    """Targets with small second differences, but for the fixed ones, which stay."""
    from scipy.sparse import diags_array, eye_array
    from scipy.sparse.linalg import spsolve

    count = len(targets)
    free = np.setdiff1d(np.arange(count), fixed)
    if not weight or not len(free):
        return targets
    # a tip is at rest before the first and after the last: there these points repeat
    middle = np.full(count, -2.0)
    middle[[0, -1]] = -1.0
    second = diags_array([np.ones(count - 1), middle, np.ones(count - 1)], offsets=[-1, 0, 1])
    normal = (eye_array(count) + weight * second.T @ second).tocsc()
    rest = list(fixed)
    known = targets[free] - normal[free][:, rest] @ targets[rest]
    out = targets.copy()
    out[free] = np.asarray(spsolve(normal[free][:, free].tocsc(), known)).reshape(known.shape)
    return out


def hats(steps: int, count: int) -> np.ndarray:
    """Shares (steps + 1, count) of knots in displacements that begin with nothing.

    They are linear between the knots, the last of which is at the last step.
    """
    at = np.linspace(0.0, count, steps + 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(1, count + 1)))


def held_stretches(stretches: Sequence[Stretch]) -> list[int]:
    """Numbers of the stretches in which something is held."""
    return [k for k, s in enumerate(stretches) if s.hold and s.held != (None, None)]


def cut(holds: Sequence[bool]) -> list[tuple[int, int, bool]]:
    """First and last + 1 of runs of equal values, and the value."""
    runs, first = [], 0
    for value, group in itertools.groupby(holds):
        last = first + len(list(group))
        runs.append((first, last, bool(value)))
        first = last
    return runs
