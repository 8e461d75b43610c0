"""A page that is served beside something else: that keeps the main thread, and with it Ctrl-C."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future

from .server import Served, Session, serving

__all__ = ["serving_beside"]


@contextlib.contextmanager
def serving_beside(session: Session, bound: socket.socket) -> Iterator[Served]:
    """Serve a session in a thread of its own while the block runs, on a socket of `listen`.

    Raises:
        BaseException: whatever ended one of its threads, at the end of a block that did not fail
            itself
    """
    started: Future[tuple[Served, asyncio.AbstractEventLoop]] = Future()

    async def serve() -> None:
        async with serving(session, bound) as served:
            started.set_result((served, asyncio.get_running_loop()))
            await served.ended.wait()  # also where its thread broke: no page waits for it in vain

    def run() -> None:
        try:
            asyncio.run(serve())
        except BaseException as error:
            if started.done():
                started.result()[0].broken = error
            else:
                started.set_exception(error)

    thread = threading.Thread(target=run, name="page server", daemon=True)
    thread.start()
    served, loop = started.result()
    try:
        yield served
    finally:
        with contextlib.suppress(RuntimeError):  # the loop has ended by itself
            loop.call_soon_threadsafe(served.ended.set)
        thread.join()
    if served.broken is not None:
        raise served.broken
