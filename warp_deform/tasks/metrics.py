"""What tasks are scored by: pure functions of points, masks and poses.

Source: Seita et al., ICRA 2021, section on tasks and its appendix.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "chord_error",
    "coverage",
    "hull_area",
    "mask_iou",
    "pose_error",
    "share_in_zone",
    "wrap_angle",
]


def wrap_angle(angle: float) -> float:
    """The same direction, from -pi to pi [rad].

    Examples:
        >>> round(wrap_angle(2 * np.pi + 0.5), 6)
        0.5
    """
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def hull_area(points: np.ndarray) -> float:
    """Area of the convex hull of `points` (n, 2) [m^2].

    Fewer than three different points, or points on a line, span 0; a point that is not finite makes
    the area nan, which is above no threshold. Source: Andrew's monotone chain.

    Examples:
        >>> hull_area(np.array([[0, 0], [2, 0], [2, 1], [0, 1], [1, 0.5]]))
        2.0
        >>> hull_area(np.array([[0, 0], [1, 1], [2, 2]]))
        0.0
    """
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    if not np.isfinite(points).all():
        return float("nan")
    if len(points) < 3:
        return 0.0
    # Near the origin the products below lose no digits to the points' common offset.
    ordered = np.unique(points - points.mean(axis=0), axis=0).tolist()
    hull: list[list[float]] = []
    for chain in (ordered, ordered[::-1]):
        start = len(hull)
        for x, y in chain:
            while len(hull) >= start + 2:
                (ax, ay), (bx, by) = hull[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                hull.pop()
            hull.append([x, y])
        hull.pop()  # the end of a chain is the start of the other
    corners = np.array(hull).reshape(-1, 2)
    following = np.roll(corners, -1, axis=0)
    doubled = np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0])
    return float(abs(doubled) / 2)


def share_in_zone(points: np.ndarray, targets: np.ndarray, tolerance: float) -> float:
    """Share of `points` (n, 2) nearer than `tolerance` to the nearest of `targets` (m, 2), all [m].

    A point that is not finite is not in the zone.

    Examples:
        >>> share_in_zone(np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([[0.01, 0.0]]), 0.02)
        0.5
    """
    offsets = np.asarray(points, dtype=float)[:, None, :2] - np.asarray(targets, dtype=float)[None]
    nearest = np.linalg.norm(offsets, axis=-1).min(axis=1)
    return float(np.mean(nearest < tolerance))


def mask_iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks of one shape; 0 when both are empty.

    Examples:
        >>> mask_iou(np.array([1, 1, 0]), np.array([0, 1, 1]))
        0.3333333333333333
    """
    a, b = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 0.0


def coverage(mask: np.ndarray, target: np.ndarray) -> float:
    """Share of `target` that `mask` covers (masks of one shape); 0 when the target is empty.

    Examples:
        >>> coverage(np.array([1, 1, 0]), np.array([0, 1, 1]))
        0.5
    """
    mask, target = np.asarray(mask, dtype=bool), np.asarray(target, dtype=bool)
    size = np.count_nonzero(target)
    return float(np.count_nonzero(mask & target) / size) if size else 0.0


def pose_error(pose: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Distance [m] and least turn [rad, 0 to pi] between two planar poses (3,) x, y [m], yaw [rad].

    Examples:
        >>> distance, turn = pose_error(np.array([0.3, 0.0, 0.1]), np.array([0.3, 0.4, 2 * np.pi]))
        >>> round(distance, 6), round(turn, 6)
        (0.4, 0.1)
    """
    x, y, yaw = np.subtract(pose, target)
    return float(np.hypot(x, y)), abs(wrap_angle(yaw))


def chord_error(beads: np.ndarray, targets: np.ndarray, *, links: int, spacing: float) -> float:
    """Return by how much chords of a chain differ in length from those of its targets.

    A chord joins beads so many links apart. It says how bent the chain is there, not where it lies.

    Args:
        beads: along the chain, (n, 2), in any unit of length
        targets: where they are to lie, (n, 2)
        links: bridged by a chord
        spacing: of the beads

    Returns:
        the mean over all chords, relative to the length of a straight one
    """
    chords, wanted_chords = (
        np.linalg.norm(points[links:] - points[:-links], axis=1) for points in (beads, targets)
    )
    return float(np.abs(chords - wanted_chords).mean()) / (links * spacing)
