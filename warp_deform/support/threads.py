"""Calls side by side on the threads of this process, for code that lets go of Python's lock."""

from __future__ import annotations

import functools
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

__all__ = ["call_side_by_side", "default_threads"]


def default_threads() -> int:
    """Threads that this process may keep busy, if nothing else is asked for.

    As many as the environment variable OMP_NUM_THREADS says, which OpenMP, torch, joblib, Ray and
    torchrun heed or set, and otherwise one a core. One in a process that multiprocessing or joblib
    started: it has others beside it.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    import joblib  # it knows the limits of containers

    return int(joblib.cpu_count())


def call_side_by_side(calls: Sequence[Callable[[], object]], threads: int) -> None:
    """Call each once, in any order, on up to so many threads, of which the caller's is one.

    All that began have ended when this returns or raises. After an error, or Ctrl-C, no further one
    begins, and the error is raised here.
    """
    waiting = deque(calls)

    def work() -> None:
        while waiting:
            try:
                call = waiting.popleft()
            except IndexError:  # another thread was faster
                return
            try:
                call()
            except BaseException:
                waiting.clear()
                raise

    helpers = _helped(work, min(threads, len(calls)) - 1)
    try:
        work()
    finally:
        waiting.clear()
        # a helper that has not begun by now has nothing left to do
        errors = [helper.exception() for helper in helpers if not helper.cancel()]
    for error in errors:
        if error is not None:
            raise error


def _helped(work: Callable[[], None], count: int) -> list[Future[None]]:
    """So many other threads begin to do `work`."""
    if count < 1:
        return []
    try:
        return [_pool(count).submit(work) for _ in range(count)]
    except RuntimeError:  # Python is about to end and starts no threads: the caller does it all
        return []


@functools.cache
def _pool(helpers: int) -> ThreadPoolExecutor:
    """Threads that wait for work, and end with Python."""
    return ThreadPoolExecutor(helpers, thread_name_prefix="warp-deform")


if hasattr(os, "register_at_fork"):  # threads stay behind when a process forks
    os.register_at_fork(after_in_child=_pool.cache_clear)
