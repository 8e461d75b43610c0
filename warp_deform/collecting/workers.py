"""Work spread over processes: joblib's loky on one machine, its Ray backend on a cluster."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import socket
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
from ..support.extras import install_extra
from ..tasks.registration import register_task
from ..tasks.registry import registered
from ..tasks.task import Task

__all__ = ["Workers", "single_threaded", "worker_count"]

Chunk = TypeVar("Chunk")
Result = TypeVar("Result")

LEAST_EPISODES = 64
"""A process takes seconds to start: by default each gets at least so many episodes."""

MOST_A_CORE = 8
"""More processes than this a core are taken for a mistake, which could use up the memory."""

_CONNECT_SECONDS = 5.0
_LOOK_SECONDS = 0.5


def worker_count(asked: int | None, episodes: int) -> int:
    """Processes to use: as asked, else one per core but no more than the work is worth."""
    if asked is not None:
        if asked < 1:
            raise InputError(f"workers is {asked}; it must be 1 or more")
        cores = int(joblib.cpu_count())
        if asked > MOST_A_CORE * cores:
            raise InputError(
                f"workers is {asked}, more than {MOST_A_CORE} for each of {cores} cores; a process "
                "takes half a gigabyte, and more than one a core gains nothing"
            )
        return asked
    return max(1, min(int(joblib.cpu_count()), episodes // LEAST_EPISODES))


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
        InputError: Ray is asked for and not installed, or its cluster does not answer.
    """

    def __init__(self, count: int | None, *, ray: str | None = None) -> None:
        self._ray = ray is not None
        self._starting: Any = None
        cores = 1 if ray is None else _connect(ray)
        self.count = count or cores

    @property
    def apart(self) -> bool:
        """Whether the work is done by other processes than this one."""
        return self._ray or self.count > 1

    def __enter__(self) -> Workers:
        """Let the processes start and import while the caller does something else."""
        if self.apart and not self._ray:
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
        calls = (joblib.delayed(_call)(function, chunk, tasks) for chunk in chunks)
        try:
            if self._starting is not None:
                for _ in self._starting:
                    pass
                self._starting = None
            if not self._ray:
                done = self._loky(calls)
                try:
                    for results in done:
                        yield from results
                finally:
                    _close(done)
                return
            with joblib.parallel_config(backend="ray", n_jobs=self.count):
                for results in joblib.Parallel(batch_size=1)(calls):
                    yield from results
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


def _connect(address: str) -> int:
    """Join a Ray cluster; the number of its cores."""
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise InputError(
            f"Ray is not installed. Run {install_extra('ray')} in the clone, or leave out --ray"
        ) from error
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself would go on trying for many minutes
            socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    except (OSError, OverflowError, ValueError) as error:
        raise InputError(f"no Ray cluster answers at {address!r}: {error}") from error
    register_ray()
    return int(ray.cluster_resources().get("CPU", 1))
