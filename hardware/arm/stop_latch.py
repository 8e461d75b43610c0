"""A stop that holds: once pressed no motion begins until somebody releases it.

A stop that only ends what moves is lost when it comes between the check of a motion and its start.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .robot import RECOVER, MotionError

__all__ = ["StopLatch"]

_AGAIN = 0.05  # [s] between stops of a motion that goes on
_LONGEST = 40.0  # [s] that a vendor may take to plan a motion, which no stop ends


class StopLatch:
    """Pressed from any thread, also from one that handles Ctrl-C in the middle of a motion."""

    def __init__(self) -> None:
        # Re-entrant: a handler of Ctrl-C may press in the middle of a press.
        self._lock = threading.RLock()
        self._presses = self._released = 0
        self._mover: int | None = None
        self._still = threading.Event()
        self._still.set()

    @property
    def pressed(self) -> bool:
        """Whether there was a stop that nobody has cleared."""
        return self._presses > self._released

    def press(self) -> None:
        """Let no motion begin from now on."""
        with self._lock:
            self._presses += 1

    def mark(self) -> int:
        """Return what `release` takes: the stops up to now."""
        return self._presses

    def release(self, mark: int) -> None:
        """Clear the stops up to `mark`; one that came later holds."""
        with self._lock:
            self._released = max(self._released, mark)

    def check(self) -> None:
        """Refuse to move after a stop.

        Raises:
            MotionError: there was one that nobody has cleared
        """
        if self.pressed:
            raise MotionError(
                "the arm was stopped by stop(), which holds until recover()",
                advice=f"see that the way is clear, then {RECOVER}",
            )

    @contextmanager
    def motion(self) -> Iterator[None]:
        """Enclose a motion of this thread; raises as `check` does, and then nothing has moved."""
        self._mover = threading.get_ident()
        self._still.clear()
        try:
            # After it is known that something is under way: a stop sees that, or is seen here.
            self.check()
            yield
        finally:
            self._mover = None
            self._still.set()

    def stop(self, halt: Callable[[], None]) -> None:
        """Press, and call `halt` until the motion under way, if any, has ended.

        Called by the thread that moves, it calls `halt` once: that thread ends the motion itself.
        """
        self.press()
        halt()
        until = time.monotonic() + _LONGEST
        while self._mover not in (None, threading.get_ident()) and time.monotonic() < until:
            if self._still.wait(_AGAIN):
                return
            halt()
