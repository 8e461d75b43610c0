"""Work spread over processes: joblib's loky on one machine, its Ray backend on a cluster."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from .errors import InputError, WarpDeformError
from .quiet import quiet_warp

__all__ = ["Workers", "single_threaded", "stop_if_orphaned", "worker_count"]

Chunk = TypeVar("Chunk")
Result = TypeVar("Result")

LEAST_EPISODES = 64
"""A process takes seconds to start: by default each gets at least so many episodes."""

_CONNECT_SECONDS = 5.0


def worker_count(asked: int | None, episodes: int) -> int:
    """Processes to use: as asked, else one per core but no more than the work is worth."""
    if asked is not None:
        if asked < 1:
            raise InputError(f"workers is {asked}; it must be 1 or more")
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

    count: processes; None takes the cluster's cores, or one process without a cluster
    `function` is an iterator of results and is importable from its module.
    ray: address of a Ray cluster ("auto" for the one this machine belongs to). Functions and chunks
    travel by joblib, files do not: a cluster needs a folder that all its machines share.

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
            self._starting = self._loky()(joblib.delayed(_import)() for _ in range(self.count))
        return self

    def __exit__(self, *error: object) -> None:
        if self._starting is not None:
            self._starting.close()

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
        owner = None if self._ray else os.getpid()
        calls = (joblib.delayed(_call)(function, chunk, owner) for chunk in chunks)
        try:
            if self._starting is not None:
                for _ in self._starting:
                    pass
                self._starting = None
            if not self._ray:
                for results in self._loky()(calls):
                    yield from results
                return
            with joblib.parallel_config(backend="ray", n_jobs=self.count):
                for results in joblib.Parallel(batch_size=1)(calls):
                    yield from results
        except TerminatedWorkerError as error:
            raise WarpDeformError(
                "a worker process was killed, perhaps for want of memory; what is complete is "
                "kept: run the same command again to go on, with fewer --workers"
            ) from error

    def _loky(self) -> joblib.Parallel:
        return joblib.Parallel(
            n_jobs=self.count, backend="loky", batch_size=1, return_as="generator_unordered"
        )


def stop_if_orphaned() -> None:
    """End a worker process whose owner was killed: nobody waits for its results any more.

    At once, without cleaning up, as the owner ended; files appear whole or not at all.
    """
    if _owner is not None and os.getppid() != _owner:
        os._exit(1)


_owner: int | None = None
"""The process that this one works for, if that one started it."""


def _import() -> None:
    """Import what takes long."""
    import torch  # noqa: F401

    from . import worlds  # noqa: F401

    quiet_warp()


def _call(
    function: Callable[[Chunk], Iterable[Result]], chunk: Chunk, owner: int | None
) -> list[Result]:
    global _owner
    _owner = owner
    quiet_warp()
    with single_threaded():
        return list(function(chunk))


def _connect(address: str) -> int:
    """Join a Ray cluster; the number of its cores."""
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise InputError(
            "Ray is not installed; run: pip install 'warp-deform[ray]', or leave out --ray"
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
