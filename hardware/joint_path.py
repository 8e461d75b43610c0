"""Way-points in joint space as the vendor's time-optimal planner can take them.

It has three traps: on a way-point that repeats the one before it searches for 30 s and gives up; it
takes a corner of half a turn at full speed, which ends in a reflex; and it rounds other corners by
up to 0.02 rad, some 10 mm at the hand. So the arm comes to rest at sharp corners.

Source of the planner: Kunz and Stilman, "Time-Optimal Trajectory Generation for Path Following with
Bounded Acceleration and Velocity", RSS 2012.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

__all__ = ["path_pieces"]

# Joints that differ by less than this repeat the way-point [rad].
STANDSTILL = 1e-3
# Cosine of the turn between two steps beyond which the arm comes to rest between them: 30 degrees.
SHARP = 0.87


def path_pieces(start: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the path cut at its sharp corners, without repetitions.

    Args:
        start: where the arm is [rad], shape (7,)
        points: where it is to go [rad], shape (N, 7)

    Returns:
        for each piece where it begins, (7,), and its way-points, (M, 7); none where the arm is
        already there
    """
    kept = [start]
    for point in points:
        if np.abs(point - kept[-1]).max() > STANDSTILL:
            kept.append(point)
    if len(kept) == 1:
        return []
    kept[-1] = points[-1]  # at most STANDSTILL away
    steps = np.diff(kept, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    corners = np.flatnonzero((steps[1:] * steps[:-1]).sum(axis=1) < SHARP) + 1
    bounds = [0, *corners.tolist(), len(kept) - 1]
    return [(kept[i], np.array(kept[i + 1 : j + 1])) for i, j in pairwise(bounds)]
