"""Work spread over a Ray cluster, which may lose machines on the way.

Source: Moritz et al., "Ray: A Distributed Framework for Emerging AI Applications", OSDI 2018: a
task whose machine is lost is run again elsewhere.
"""

from __future__ import annotations

import contextlib
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from ..errors import InputError, WarpDeformError
from ..support.extras import install_extra

__all__ = ["joined", "unordered"]

Chunk = TypeVar("Chunk")
Result = TypeVar("Result")

_CONNECT_SECONDS = 5.0
_TRIES = 5
"""A chunk that was lost so often, perhaps as it brings its process down, is given up."""


@contextlib.contextmanager
def joined(address: str) -> Iterator[int]:
    """A Ray cluster while it is worked on ("auto" is the one this machine belongs to); its cores.

    Ray tells the standard output what becomes of its machines; here that goes to standard error,
    for the output is the caller's. A program that has joined a cluster itself stays joined.

    Raises:
        InputError: Ray is not installed, or no cluster answers.
    """
    try:
        import ray
    except ImportError as error:
        raise InputError(
            f"Ray is not installed. Run {install_extra('ray')} in the clone, or leave out --ray"
        ) from error
    if ray.is_initialized():
        yield _cores(ray)
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    with contextlib.redirect_stdout(sys.stderr):
        try:
            if host and port.isdecimal():  # Ray itself would go on trying for many minutes
                socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
            ray.init(address=address, logging_level="WARNING", log_to_driver=False)
        except (OSError, OverflowError, ValueError) as error:
            raise InputError(f"no Ray cluster answers at {address!r}: {error}") from error
        try:
            yield _cores(ray)
        finally:
            ray.shutdown()


def _cores(ray: Any) -> int:
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def unordered(
    function: Callable[[Chunk], Result], chunks: Sequence[Chunk], most: int
) -> Iterator[Result]:
    """Results of the chunks as they come, with at most so many at work.

    What a lost machine had in hand is done again on another one. An exception of `function` itself
    is raised here. Whoever stops to ask for results ends what is still at work.

    Raises:
        WarpDeformError: a chunk was lost several times.
    """
    import ray

    remote: Any = ray.remote(num_cpus=1, max_retries=_TRIES - 1)(_apply)
    waiting = list(reversed(chunks))
    at_work: list[Any] = []
    try:
        while waiting or at_work:
            while waiting and len(at_work) < most:
                at_work.append(remote.remote(function, waiting.pop()))
            (done, *_), at_work = ray.wait(at_work)
            try:
                yield ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None
    except ray.exceptions.RayError as error:
        raise WarpDeformError(
            f"work was lost {_TRIES} times with its process, perhaps because memory ran out; what "
            "is complete is kept: run the same command again to go on"
        ) from error
    finally:
        for each in at_work:
            ray.cancel(each, force=True)


def _apply(function: Callable[[Chunk], Result], chunk: Chunk) -> Result:
    """What a process of the cluster does; Ray takes plain functions alone."""
    return function(chunk)
