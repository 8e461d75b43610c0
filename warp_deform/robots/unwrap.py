"""Which turn of a revolute joint each waypoint of a path should use."""

from __future__ import annotations

import math

import numpy as np

__all__ = ["unwrap"]

TURN = 2.0 * math.pi


def unwrap(
    angle: np.ndarray, starts: np.ndarray, reference: np.ndarray, low: float, high: float
) -> np.ndarray:
    """Return angles [rad] that equal `angle` up to whole turns and change little along each path.

    Paths begin at the rows `starts`; `reference` is where the joint stands before each. Without
    limits every change is half a turn at most, and the path as a whole takes the turn nearest
    its reference that keeps it within `low` and `high`. A path for which there is no such turn gets
    the sequence within the limits that moves least; an angle that no turn brings within the limits
    is left outside them, by the least.

    Shapes: angle (N,), starts and reference (paths,).
    """
    counts = np.diff(np.append(starts, len(angle)))
    turns = np.zeros(len(angle))
    turns[1:] = -np.cumsum(np.rint(np.diff(angle) / TURN))
    smooth = angle + TURN * (turns - np.repeat(turns[starts], counts))
    least, most = np.minimum.reduceat(smooth, starts), np.maximum.reduceat(smooth, starts)
    wanted = np.rint((reference - smooth[starts]) / TURN)
    first, last = np.ceil((low - least) / TURN), np.floor((high - most) / TURN)
    result = smooth + TURN * np.repeat(np.clip(wanted, first, last), counts)
    for path in np.flatnonzero(first > last):
        rows = slice(starts[path], starts[path] + counts[path])
        result[rows] = _least_motion(angle[rows].tolist(), float(reference[path]), low, high)
    return result


def _least_motion(angles: list[float], reference: float, low: float, high: float) -> list[float]:
    """Return whole-turn equivalents within the limits with the least total motion, by Viterbi."""
    # Cost and path of the best sequence that ends in each candidate of the latest waypoint.
    best: list[tuple[float, list[float]]] = [(0.0, [reference])]
    for angle in angles:
        first, last = math.ceil((low - angle) / TURN), math.floor((high - angle) / TURN)
        candidates = [angle + TURN * turn for turn in range(first, last + 1)]
        # None: the nearer of the two just outside, for the rest of the arm may make up for it.
        below, above = angle + TURN * last, angle + TURN * first
        candidates = candidates or [below if low - below <= above - high else above]
        best = [
            min((cost + abs(candidate - path[-1]), [*path, candidate]) for cost, path in best)
            for candidate in candidates
        ]
    return min(best)[1][1:]
