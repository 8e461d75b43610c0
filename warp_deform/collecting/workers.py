"""Work spread over processes: of joblib's loky on one machine, or of a Ray cluster."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError, _ExecutorManagerThread

from ..errors import InputError, WarpDeformError
from ..quiet import quiet_warp
from ..support.garbage import collect_rarely
from ..tasks.registration import register_task
from ..tasks.registry import registered
from ..tasks.task import Task
from . import cluster

__all__ = ["Workers", "single_threaded", "worker_count"]

Chunk = TypeVar("Chunk")
Result = TypeVar("Result")

LEAST_EPISODES = 64
"""A process takes seconds to start: by default each gets at least so many episodes."""

MOST_A_CORE = 8
"""More processes than this a core are taken for a mistake, which could use up the memory."""

_LOOK_SECONDS = 0.5


def worker_count(asked: int | None, episodes: int) -> int:
    """Processes to use: as asked, else one per core but no more than the work is worth."""
    if asked is not None:
        return _checked(asked, int(joblib.cpu_count()))
    return max(1, min(int(joblib.cpu_count()), episodes // LEAST_EPISODES))


def _checked(asked: int, cores: int) -> int:
    if asked < 1:
        raise InputError(f"workers is {asked}; it must be 1 or more")
    if asked > MOST_A_CORE * cores:
        raise InputError(
            f"workers is {asked}, more than {MOST_A_CORE} for each of {cores} cores; a process "
            "takes half a gigabyte, and more than one a core gains nothing"
        )
    return asked


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Torch and OpenCV use one thread for a while: every core has a process of its own."""
    import cv2
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


class Workers:
    """Processes that all run one function on chunks of work; one process is the present one.

        with Workers(2) as workers:
            for result in workers.run(function, chunks):
                ...

    `function` is an iterator of results and is importable from its module. Tasks that the user
    registered travel along: by their module's name, or as they are where they stand in a script.
    Functions and chunks travel to a cluster, files do not: it needs a folder that all its machines
    share.

    Args:
        count: processes; None takes the cluster's cores, or one process without a cluster
        ray: address of a Ray cluster ("auto" for the one this machine belongs to)

    Raises:
        InputError: Ray is asked for and not installed, its cluster does not answer, or `count` is
            out of proportion to its cores.
    """

    def __init__(self, count: int | None, *, ray: str | None = None) -> None:
        self._ray = ray
        self._joined = contextlib.ExitStack()
        self._starting: Any = None
        if ray is None:
            self.count = count or 1
        else:
            with cluster.joined(ray) as cores:
                self.count = cores if count is None else _checked(count, cores)

    @property
    def apart(self) -> bool:
        """Whether the work is done by other processes than this one."""
        return self._ray is not None or self.count > 1

    def __enter__(self) -> Workers:
        """Let the processes start and import while the caller does something else."""
        if self._ray is not None:
            self._joined.enter_context(cluster.joined(self._ray))
        elif self.apart:
            try:
                self._starting = self._loky(joblib.delayed(_import)() for _ in range(self.count))
            except KeyboardInterrupt:
                _interrupted()
                raise
        return self

    def __exit__(self, *error: object) -> None:
        if error[0] is KeyboardInterrupt:
            _interrupted()
        if self._starting is not None:
            _close(self._starting)
        self._joined.close()

    def run(
        self, function: Callable[[Chunk], Iterable[Result]], chunks: Sequence[Chunk]
    ) -> Iterator[Result]:
        """Results in the order in which they come; from other processes, a chunk at a time.

        Raises:
            WarpDeformError: a process died, for want of memory for instance.
        """
        if not self.apart:
            with single_threaded():
                for chunk in chunks:
                    yield from function(chunk)
            return
        tasks = registered()
        if self._ray is not None:
            call = functools.partial(_call, function, tasks=tasks)
            for results in cluster.unordered(call, chunks, self.count):
                yield from results
            return
        calls = (joblib.delayed(_call)(function, chunk, tasks) for chunk in chunks)
        try:
            if self._starting is not None:
                for _ in self._starting:
                    pass
                self._starting = None
            done = self._loky(calls)
            try:
                for results in done:
                    yield from results
            finally:
                _close(done)
        except TerminatedWorkerError as error:
            raise WarpDeformError(
                "a worker process was killed, perhaps because memory ran out; what is complete is "
                "kept: run the same command again to go on, with fewer --workers"
            ) from error

    def _loky(self, calls: Iterable[Any]) -> Generator[Any, None, None]:
        parallel = joblib.Parallel(
            n_jobs=self.count,
            backend="loky",
            batch_size=1,
            return_as="generator_unordered",
            initializer=_serve,
            initargs=(os.getpid(),),
        )
        # Ctrl-C reaches every process of a terminal. Workers, which inherit this mask, leave it to
        # their owner, also while they still import; to this process it comes when they have begun.
        resource_tracker.ensure_running()  # it would lift the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            done: Generator[Any, None, None] = parallel(calls)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return done


def _close(results: Generator[Any, None, None]) -> None:
    """End what still runs, without joblib's warning that results are left behind."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results.close()


def _serve(owner: int) -> None:
    """Work in this process as long as the one that started it lives, even if that is killed."""
    collect_rarely()
    threading.Thread(target=_leave_with, args=(owner,), daemon=True).start()


def _leave_with(owner: int) -> None:
    """End this process when `owner` has: at once, for files appear whole or not at all."""
    while os.getppid() == owner:
        time.sleep(_LOOK_SECONDS)
    os._exit(1)


def _interrupted() -> None:
    """Have joblib's threads end without a word."""
    threading.excepthook = functools.partial(_report_others, threading.excepthook)


def _report_others(
    report: Callable[[threading.ExceptHookArgs], object], error: threading.ExceptHookArgs
) -> None:
    """Report a thread's exception, but not that of loky's own.

    That thread stumbles over the processes that an interrupted start left half-made; the user has
    been told of the interruption.
    """
    if not isinstance(error.thread, _ExecutorManagerThread):
        report(error)


def _import() -> None:
    """Import what takes long."""
    import torch  # noqa: F401

    from ..worlds import worlds  # noqa: F401

    quiet_warp()


def _call(
    function: Callable[[Chunk], Iterable[Result]], chunk: Chunk, tasks: tuple[type[Task], ...]
) -> list[Result]:
    """Results of a chunk, in a process that is first told which tasks the user registered."""
    quiet_warp()
    for task in tasks:
        register_task(task)
    with single_threaded():
        return list(function(chunk))
