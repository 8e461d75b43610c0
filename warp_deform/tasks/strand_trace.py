"""Where a cable leads in a mask: points along it from one end to the other.

The mask is thinned to a line one pixel wide, which is cut where strands meet; the pieces are then
linked end to end into one open line, in the order whose links together are shortest and turn
least. A link over the mask, where another strand may hide this one, counts less than one over bare
ground. The points are spread evenly along the line. So of two strands that cross, each goes
straight on. What a mask does not show, which strand lies on top and what is hidden where strands
lie side by side, is a guess.

Sources: of the thinning, Zhang and Suen, "A fast parallel algorithm for thinning digital patterns",
1984; of the order, Held and Karp, "A dynamic programming approach to sequencing problems", 1962.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

__all__ = ["trace_strand"]

_REACH = 7  # [px] of a piece that tell where its end points
_SHORT = 5  # [px]: a shorter piece, a spur of the thinning or a speck, has no direction
_MOST = 10  # pieces that are put in order, the longest: the time doubles with each
_COVERED = 0.2  # of the length of a link that lies on the mask
_TURN = 12.0  # [px] that a link turning back costs more than one going straight on
_WIDE = 2  # [px] of a thin line across, at its corners
_EATEN = 8  # [px] of an end at most
_SMOOTH = 5  # points


def trace_strand(mask: np.ndarray, points: int) -> np.ndarray | None:
    """Return rows and columns [px] of so many points along the cable of a mask, (points, 2).

    The mask (H, W) is bool, or 0 where there is no cable.

    Which end comes first is arbitrary. None where the mask shows no cable.
    """
    mask = mask.astype(bool)
    pieces = _pieces(_thinned(mask))
    if not pieces:
        return None
    line = _joined(pieces, mask)
    if len(line) < 2:
        return None
    for _ in range(2):
        line = _prolonged(line, mask)[::-1]
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    even = np.linspace(0.0, along[-1], points)
    return np.stack([np.interp(even, along, line[:, k]) for k in range(2)], axis=1)


def _thinned(mask: np.ndarray) -> np.ndarray:
    """The mask's middle lines, (H, W) bool."""
    image = mask
    while True:
        before = np.count_nonzero(image)
        for first in (True, False):
            ring = _ring(image)
            above, right, below, left = ring[::2]
            if first:
                free = ~(above & right & below) & ~(right & below & left)
            else:
                free = ~(above & right & left) & ~(above & below & left)
            count = np.sum(ring, axis=0)
            image = image & ~((count >= 2) & (count <= 6) & (_rises(ring) == 1) & free)
        if np.count_nonzero(image) == before:
            return image


def _ring(image: np.ndarray) -> list[np.ndarray]:
    """The eight neighbours of every pixel, clockwise from the one above, (H, W) bool each."""
    padded = np.pad(image, 1)
    rows, columns = image.shape
    steps = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))
    return [padded[r : r + rows, c : c + columns] for r, c in steps]


def _rises(ring: list[np.ndarray]) -> np.ndarray:
    """How often the ring about every pixel goes from background to line, (H, W) int."""
    turned = ring[1:] + ring[:1]
    rises: np.ndarray = np.sum([~a & b for a, b in zip(ring, turned, strict=True)], axis=0)
    return rises


def _pieces(thin: np.ndarray) -> list[np.ndarray]:
    """Lines between places where strands meet, (n, 2) rows and columns in order each."""
    ring = _ring(thin)
    # three branches or more, or a clump, as where strands cross at a right angle
    meeting = (thin & ((_rises(ring) > 2) | (np.sum(ring, axis=0) > 4))).astype(np.uint8)
    lone = thin & ~cv2.dilate(meeting, np.ones((3, 3), np.uint8)).astype(bool)
    number, labels = cv2.connectedComponents(lone.astype(np.uint8), connectivity=8)
    pieces = [_walked(np.argwhere(labels == i)) for i in range(1, number)]
    return [piece for piece in pieces if len(piece) >= _SHORT] or pieces


def _walked(pixels: np.ndarray) -> np.ndarray:
    """The pixels (n, 2) of a thin line in their order along it."""
    neighbours = np.abs(pixels[:, None] - pixels[None]).max(axis=-1) == 1
    steps = _steps(neighbours, int(np.argmax(_steps(neighbours, 0))))
    half = pixels[steps == steps.max() // 2]
    # from anywhere on a closed line there are two ways half round: it is cut where they began
    if len(pixels) > 2 * _SHORT and np.ptp(half, axis=0).max() > _WIDE:
        return _walked(pixels[steps > 1])
    return pixels[np.argsort(steps, kind="stable")]


def _steps(neighbours: np.ndarray, start: int) -> np.ndarray:
    """How many steps every pixel is from `start`, (n,)."""
    steps = np.full(len(neighbours), -1)
    front, count = np.array([start]), 0
    while len(front):
        steps[front] = count
        front = np.flatnonzero(neighbours[front].any(axis=0) & (steps < 0))
        count += 1
    return steps


def _joined(pieces: list[np.ndarray], mask: np.ndarray) -> np.ndarray:
    """One line (n, 2) through the pieces, smoothed."""
    longest = sorted(pieces, key=len)[-_MOST:]
    line = np.concatenate(_in_order([piece.astype(float) for piece in longest], mask))
    padded = np.pad(line, ((_SMOOTH // 2, _SMOOTH // 2), (0, 0)), mode="edge")
    kernel = np.full(_SMOOTH, 1.0 / _SMOOTH)
    smooth = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in range(2)], axis=1)
    smooth[[0, -1]] = line[[0, -1]]
    return smooth


def _in_order(lines: list[np.ndarray], mask: np.ndarray) -> list[np.ndarray]:
    """Lines in the order, each in the direction, in which linking them all costs least."""
    ways = [(k, line[::sense]) for k, line in enumerate(lines) for sense in (1, -1)]
    costs = np.full((len(ways), len(ways)), np.inf)
    for (i, (k, first)), (j, (other, second)) in itertools.permutations(enumerate(ways), 2):
        if k != other:
            costs[i, j] = _cost(first, second, mask)
    # by set of lines, as bits, and by the way that comes last: least cost and the way before it
    bits = np.array([1 << k for k, _ in ways])
    least = np.full((1 << len(lines), len(ways)), np.inf)
    before = np.full(least.shape, -1)
    least[bits, np.arange(len(ways))] = 0.0
    for done in range(1, len(least)):
        through = least[done][:, None] + costs
        nearest = through.argmin(axis=0)
        for way in np.flatnonzero((bits & done) == 0):
            more, cost = done | bits[way], through[nearest[way], way]
            if cost < least[more, way]:
                least[more, way], before[more, way] = cost, nearest[way]
    left, last = len(least) - 1, int(least[-1].argmin())
    order = []
    while last >= 0:
        order.append(ways[last][1])
        left, last = left ^ int(bits[last]), int(before[left, last])
    return order[::-1]


def _prolonged(line: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The line with its end gone on straight to the strand's: thinning eats up what is pointed."""
    ahead = line[-1] - line[max(len(line) - 1 - _REACH, 0)]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    further = []
    for step in range(1, _EATEN + 1):
        row, column = np.rint(line[-1] + (step + 1.0) * ahead).astype(int)
        inside = 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]
        if not inside or not mask[row, column]:
            break
        further.append(line[-1] + step * ahead)
    return np.concatenate([line, further]) if further else line


def _cost(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """What it costs [px] to go on from the end of one line to the beginning of another."""
    leaving = first[-1] - first[max(len(first) - 1 - _REACH, 0)]
    arriving = second[min(_REACH, len(second) - 1)] - second[0]
    gap = second[0] - first[-1]
    length = float(np.linalg.norm(gap))
    turns = 1.0 - _cosine(leaving, arriving)
    # a short gap's own direction is that of the pixels' grid
    aside = (2.0 - _cosine(leaving, gap) - _cosine(gap, arriving)) * min(length / 6.0, 1.0)
    bare = 1.0 - (1.0 - _COVERED) * _covered(first[-1], second[0], mask)
    return bare * length + _TURN * (0.5 * turns + 0.5 * aside)


def _covered(start: np.ndarray, end: np.ndarray, mask: np.ndarray) -> float:
    """What part of the straight line between two pixels lies on the mask."""
    steps = max(int(np.linalg.norm(end - start)), 1)
    pixels = np.rint(np.linspace(start, end, steps + 1)).astype(int)
    return float(mask[tuple(pixels.T)].mean())


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    scale = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / scale if scale > 0.0 else 0.0
