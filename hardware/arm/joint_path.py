"""Waypoints in joint space as the vendor's time-optimal planner can take them.

It has three traps: on a waypoint that repeats the one before it searches for 30 s and gives up; it
takes a corner of half a turn at full speed, which ends in a reflex; and it rounds other corners by
up to 0.02 rad, some 10 mm at the hand. So the arm comes to rest at sharp corners.

Source of the planner: Kunz and Stilman, "Time-Optimal Trajectory Generation for Path Following with
Bounded Acceleration and Velocity", RSS 2012.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

__all__ = ["SHARP", "corner_cuts", "path_pieces"]

# Joints that differ by less than this repeat the waypoint [rad].
STANDSTILL = 1e-3
SHARP = 0.87
"""Cosine of the turn between two steps beyond which the arm comes to rest between them: 30 deg."""
# How far the vendor's planner may leave a corner that it rounds [rad].
_ROUNDED = 0.02


def path_pieces(start: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the path cut at its sharp corners, without repetitions.

    Args:
        start: where the arm is [rad], shape (7,)
        points: where it is to go [rad], shape (N, 7)

    Returns:
        for each piece where it begins, (7,), and its waypoints, (M, 7); none where the arm is
        already there
    """
    waypoints = [start]
    for point in points:
        if np.abs(point - waypoints[-1]).max() > STANDSTILL:
            waypoints.append(point)
    if len(waypoints) == 1:
        return []
    waypoints[-1] = points[-1]  # at most STANDSTILL away
    while len(waypoints) > 1 and np.abs(waypoints[-1] - waypoints[-2]).max() <= STANDSTILL:
        if len(waypoints) == 2:
            return []
        del waypoints[-2]
    steps = np.diff(waypoints, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    corners = np.flatnonzero((steps[1:] * steps[:-1]).sum(axis=1) < SHARP) + 1
    bounds = [0, *corners.tolist(), len(waypoints) - 1]
    return [(waypoints[i], np.array(waypoints[i + 1 : j + 1])) for i, j in pairwise(bounds)]


def corner_cuts(path: np.ndarray) -> list[np.ndarray]:
    """Return the chords (2, 7) across the corners of a path (N, 7) [rad] that may be rounded.

    What is executed there lies between the corner and its chord.
    """
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    units = steps / lengths[:, None]
    cuts = []
    for i in range(len(steps) - 1):
        cosine = float(units[i] @ units[i + 1])
        half = 0.5 * np.arccos(np.clip(cosine, -1.0, 1.0))
        if cosine < SHARP or half < 1e-6:
            continue
        reach = min(
            0.5 * lengths[i], 0.5 * lengths[i + 1], _ROUNDED * np.sin(half) / (1.0 - np.cos(half))
        )
        corner = path[i + 1]
        cuts.append(np.array([corner - reach * units[i], corner + reach * units[i + 1]]))
    return cuts
