"""How often Python looks for garbage in a process that imports a simulator."""

from __future__ import annotations

import atexit
import gc

__all__ = ["collect_rarely"]

_LONG_LIVED = 100
"""So many searches of the middle generation pass before one of all that has lived long; else 10."""


def collect_rarely() -> None:
    """Look more rarely through what has lived long, and no more when this process ends.

    Newton and torch make 700,000 objects that stay. Python would look through the growing heap
    seven times while they are imported, and in the end once more, which takes as long as importing
    one of the two. What is short-lived is found as often as before.
    """
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _LONG_LIVED)
    atexit.register(gc.freeze)
