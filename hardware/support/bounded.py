"""Blocking calls into a vendor's library that must neither hang nor swallow Ctrl-C."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

__all__ = ["POLL", "run_bounded"]

T = TypeVar("T")
POLL = 0.05
"""How often a waiting thread looks for Ctrl-C [s]."""
STOP_TIMEOUT = 3.0  # [s] for a stopped call to end


def run_bounded(
    call: Callable[[], T],
    *,
    timeout_s: float,
    stop: Callable[[], None] | None = None,
    watch: Callable[[], None] | None = None,
) -> T:
    """Return `call()`, made in another thread and waited for at most `timeout_s`.

    On a timeout, and on Ctrl-C, `stop()` is called and the call gets a moment to end; where it does
    not, or there is no `stop`, its thread is left behind. Where `watch`, called while waiting,
    raises an error, the call is given up without `stop`.

    The limit holds for calls that let go of Python's lock while they wait. One that keeps it stops
    this thread as well, and Ctrl-C, until it returns: whoever makes it has to know that it will. It
    then counts as ended, however late.

    The thread is new, for libfranka gives the one that it moves a robot in the highest real-time
    priority and leaves it so.

    Raises:
        TimeoutError: the call did not end in time
        KeyboardInterrupt: on Ctrl-C, after stopping
        Exception: whatever the call raises, or `watch`
    """
    results: list[T] = []
    errors: list[BaseException] = []
    # Not Thread.join: interrupted by Ctrl-C, Python 3.11's takes the thread for ended.
    ended = threading.Event()

    def run() -> None:
        try:
            results.append(call())
        except BaseException as error:  # handed on to the waiting thread below
            errors.append(error)
        finally:
            ended.set()

    def give_up() -> None:
        if stop is not None:
            stop()
            ended.wait(STOP_TIMEOUT)

    deadline = time.monotonic() + timeout_s
    try:
        threading.Thread(target=run, daemon=True).start()
        while not ended.wait(POLL) and time.monotonic() < deadline:
            if watch is not None:
                watch()
    except KeyboardInterrupt:
        give_up()
        raise
    if not ended.wait(POLL):  # a call that kept the lock has only now let this thread look
        give_up()
        raise TimeoutError(f"no answer in {timeout_s:g} s")
    if errors:
        raise errors[0]
    return results[0]
