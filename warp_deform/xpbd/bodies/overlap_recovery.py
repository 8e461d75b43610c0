"""How much of an overlap with a body a substep undoes: a fifth, so that it does not become speed.

What a contact corrects beyond stopping an approach is velocity in the next substep. A box between
two contacts, such as a fabric that is taut over it and the table below, would be thrown from one to
the other for ever: each undoes the overlap that the other has left, and the box comes back as fast
as it came. With a share of it, every return is slower.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

__all__ = ["overlap_recovery"]

GIVEN_BACK = 0.2
"""Share of an overlap that a substep undoes."""


@functools.cache
def overlap_recovery(scalar: Any) -> SimpleNamespace:
    """`remaining(overlap, max_recovery)`: what a substep leaves of the overlap that it began with,
    of which it undoes at most `max_recovery` [m].

    `correction(inside, approach, max_recovery)`: how far a contact parts two points that are
    `inside` each other [m] and have gone apart by `approach` in this substep. An approach, where
    that is negative, is undone in full.
    """
    S = scalar

    @wp.func
    def remaining(overlap: S, max_recovery: S):
        return wp.max(overlap - max_recovery, overlap * S(1.0 - GIVEN_BACK))

    @wp.func
    def correction(inside: S, approach: S, max_recovery: S):
        overlap = wp.max(inside + approach, S(0.0))
        return wp.max(inside - remaining(overlap, max_recovery), S(0.0))

    return SimpleNamespace(remaining=remaining, correction=correction)
