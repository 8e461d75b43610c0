"""Knots in open chains: a loose overhand knot, and whether a chain is knotted."""

from __future__ import annotations

import numpy as np

from ..support.checked import POSITIVE, Interval, check_number, real_array

__all__ = ["overhand_knot", "untied"]

_OPENED = 0.6
"""How much of the trefoil is cut away on either side of a lobe's end [rad]."""
_SHAKEN = 1e-5
"""By how much of a link points are shaken before they are looked at."""
_LOOPS = Interval(low=1.0, high=100.0)
"""Sizes of loops, in thirds of their reach in spacings."""
_RISE = 0.55
"""Height of the strands above and below the middle, so that they touch where they cross."""


def overhand_knot(beads: int, spacing: float, loops: float) -> np.ndarray:
    """Beads (beads, 3) [m] of a loose overhand knot, from one end at +x to the other at -x.

    A trefoil that is opened at one of its lobes, whose ends are bent outwards. Its lobes reach
    three times `loops` spacings from its centre, the origin, and the lowest bead touches the table.

    Raises:
        InputError: `spacing` is not positive, `loops` is below 1, where strands would lie in each
            other, or there are too few beads to go round the knot.
    """
    check_number(spacing, "spacing", POSITIVE)
    check_number(loops, "loops", _LOOPS)
    t = np.linspace(_OPENED - np.pi, np.pi - _OPENED, 400)
    x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    knot = np.column_stack([loops * x, loops * y, -_RISE * np.sin(3 * t)])
    first = _tail(knot[0], knot[0] - knot[1], loops)
    last = _tail(knot[-1], knot[-1] - knot[-2], loops)
    curve = np.concatenate([first[::-1], knot, last])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
    inner = way[len(first) + len(knot) - 1] - way[len(first)]
    check_number(beads, "beads", Interval(low=int(np.ceil(inner)) + 2, whole=True))
    at = way[-1] / 2 + np.arange(beads) - (beads - 1) / 2
    points = np.column_stack([np.interp(at, way, column) for column in curve.T])
    points[:, 2] += 0.5 - points[:, 2].min()
    return spacing * points


def _tail(begin: np.ndarray, way: np.ndarray, loops: float) -> np.ndarray:
    """Points from a lobe's end (3,) on along `way` (3,), around and outwards; in spacings."""
    outwards = np.array([np.sign(begin[0]), 0.0, 0.0])
    end = np.array([5.0 * loops * outwards[0], -3.5 * loops, -_RISE])
    length = np.linalg.norm(end - begin)
    level = length * np.append(way[:2], 0.0) / np.hypot(way[0], way[1])
    u = np.linspace(0.0, 1.0, 100)[1:, None]
    bend = (2 * u**3 - 3 * u**2 + 1) * begin + (u**3 - 2 * u**2 + u) * level
    bend += (3 * u**2 - 2 * u**3) * end + (u**3 - u**2) * length * outwards
    return np.concatenate([bend, [end + 100.0 * outwards]])


def untied(points: np.ndarray) -> bool:
    """Whether an open chain through `points` (P, 3) is seen to have no knot.

    Points are taken out as long as no link goes through the triangle of a point and its two
    neighbours. What ends as one straight link has no knot. What does not may also be a tangle that
    this does not get straight; ends stay where they are, so one that still sticks out through two
    loops counts as tied.

    Source: Koniaris and Muthukumar, Phys. Rev. Lett. 66 (1991); Taylor, Nature 406 (2000).

    Raises:
        InputError: `points` has another shape or is not finite.
    """
    chain = real_array(points, (len(points), 3), name="points", finite=True)
    if len(chain) > 1:
        # beads on a table lie in one plane, where "through" has no meaning; strands that do not
        # touch go by each other as before
        chain = chain - chain.mean(axis=0)
        chain /= max(np.abs(chain).max(), np.finfo(float).tiny)  # products of lengths stay finite
        links = np.linalg.norm(np.diff(chain, axis=0), axis=1)
        shake = np.random.default_rng(0).normal(0.0, _SHAKEN * np.median(links), chain.shape)
        chain = chain + shake
    while len(chain) > 2:
        pierced = _pierced(chain[:-2], chain[1:-1], chain[2:], chain[:-1], chain[1:])
        triangle, link = np.indices(pierced.shape)
        # links that begin or end at its corners do not go through a triangle
        pierced &= (link < triangle - 1) | (link > triangle + 2)
        (free,) = np.nonzero(~pierced.any(axis=1))
        if not len(free):
            return False
        chain = np.delete(chain, _together(free, chain) + 1, axis=0)
    return True


def _together(free: np.ndarray, chain: np.ndarray) -> np.ndarray:
    """Triangles out of `free`, by number, whose middle points can be taken out at once."""
    some = free[free % 2 == free[0] % 2]
    a, b, c = chain[some], chain[some + 1], chain[some + 2]
    # two that nothing goes through may still be in the way of each other's new links
    pierced = _pierced(a, b, c, a, c)
    touching = np.abs(some[:, None] - some) <= 2
    return some[:1] if (pierced & ~touching).any() else some


def _pierced(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, begins: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Whether triangles of corners (n, 3) each are gone through by links (m, 3) each: (n, m).

    A line goes through a triangle if it passes all of its edges on the same side. On which side two
    lines pass each other is an inner product of their Pluecker coordinates.
    """
    ways, moments = _line(begins, ends)
    sides = []
    for corner, other in ((a, b), (b, c), (c, a)):
        way, moment = _line(corner, other)
        sides.append(way @ moments.T + moment @ ways.T)
    one, two, three = sides
    through = ((one >= 0) & (two >= 0) & (three >= 0)) | ((one <= 0) & (two <= 0) & (three <= 0))
    normals = _cross(b - a, c - a)
    levels = (normals * a).sum(axis=1, keepdims=True)
    return through & ((normals @ begins.T > levels) != (normals @ ends.T > levels))


def _line(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pluecker coordinates of lines through points (n, 3): directions and moments."""
    return ends - begins, _cross(begins, ends)


def _cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Cross products (n, 3); of a few vectors this is much faster than NumPy's."""
    ahead, behind = [1, 2, 0], [2, 0, 1]
    return one[:, ahead] * two[:, behind] - one[:, behind] * two[:, ahead]
