"""The server: files and one WebSocket on the loopback interface, one thread for the simulation.

The event loop only moves bytes. One thread owns the session, and with it the worlds: jobs wait for
it in one bounded queue, and what it has to say goes to the tabs in the order in which it says it.
Urgent jobs go before all that wait, and are never refused: one at a time of every tab.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import itertools
import queue
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import InputError, WarpDeformError
from ..support.extras import install_extra
from .access import FILES, HEADERS, Access, StaticFile
from .wire import MOST_BYTES, Job, NotUnderstoodError, Verbs, pack, parse_job

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

__all__ = ["Post", "Served", "Session", "listen", "serve_until_interrupted", "serving"]

MOST_JOBS = 16
"""Jobs that wait for the simulation; further ones are refused."""
MOST_MESSAGES = 16
"""Messages that wait for one tab; a tab that does not read them is cut off."""
MOST_TABS = 8
_LAST_MESSAGES = 1.0
"""Time for tabs to take the last messages before the server ends [s]."""
_NOT_UNDERSTOOD, _TOO_MANY = 1003, 1013


class Post(Protocol):
    """How a session answers."""

    def __call__(self, message: bytes, *, everyone: bool = True) -> None:
        """Send a message to every tab, or to the one that asked."""


class Session(Protocol):
    """What a page shows and does; every method is called by one thread."""

    files: Mapping[str, StaticFile]
    """What is served beside `access.FILES`; "" is what is served at the address itself."""
    verbs: Verbs
    """What a page may ask for."""
    urgent: frozenset[str]
    """Verbs that wait for no other job."""
    stop: threading.Event
    """Is set when a person wants a long job to end."""

    def greet(self) -> list[bytes]:
        """All that a new tab needs to show the present state."""

    def do(self, job: Job, post: Post) -> None:
        """Do what a page asks for.

        Raises:
            WarpDeformError: it cannot be done, and nothing has been; the page is told.
        """


@dataclass(eq=False)
class _Tab:
    connection: ServerConnection
    waiting: asyncio.Queue[bytes] = field(default_factory=lambda: asyncio.Queue(MOST_MESSAGES))
    greeted: bool = False
    urges: bool = False


@dataclass(frozen=True, eq=False)
class _Asked:
    """A job and whose it is: None is the program itself; no job asks for the greeting."""

    tab: _Tab | None
    job: Job | None


class Served:
    """A session that tabs are connected to.

    Attributes:
        access: who may connect
        broken: what ended the simulation's thread, None while it works
    """

    def __init__(self, session: Session, access: Access) -> None:
        self.access = access
        self.broken: BaseException | None = None
        self.ended = asyncio.Event()
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._jobs: queue.PriorityQueue[tuple[int, int, _Asked | None]] = queue.PriorityQueue()
        self._numbers = itertools.count()
        self._waiting = 0
        self._tabs: list[_Tab] = []
        # a daemon: where it is at work for minutes, the process does not wait for it
        self._thread = threading.Thread(target=self._work, name="page", daemon=True)
        self._thread.start()

    async def close(self) -> None:
        """Let the job in hand end, and the thread; tabs have a moment for what was said last."""
        self._session.stop.set()
        self._queue(None)
        await asyncio.to_thread(self._thread.join, 10.0)
        sent = [asyncio.create_task(tab.waiting.join()) for tab in self._tabs]
        if sent:
            await asyncio.wait(sent, timeout=_LAST_MESSAGES)
        for each in sent:
            each.cancel()

    def tell(self, job: Job) -> None:
        """Have the session do a job of the program's own; from any thread, in their order."""
        self._in_loop(self._ask, _Asked(None, job))

    def request(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to an HTTP request; None lets it become a WebSocket."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        headers = request.headers
        answer = self.access.decide(
            request.path,
            hosts=headers.get_all("Host"),
            origins=headers.get_all("Origin"),
            upgrade="upgrade" in headers,
        )
        if answer.status == 101:
            return None
        body = answer.file.read() if answer.file else b""
        kind = answer.file.kind if answer.file else "text/plain"
        told = {**HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}
        phrase = http.HTTPStatus(answer.status).phrase
        return Response(answer.status, phrase, Headers(told), body)

    async def handle(self, connection: ServerConnection) -> None:
        """Serve one tab until it goes."""
        from websockets.exceptions import ConnectionClosed

        if len(self._tabs) >= MOST_TABS:
            await connection.close(_TOO_MANY, f"{MOST_TABS} tabs are open")
            return
        tab = _Tab(connection)
        self._tabs.append(tab)
        sender = asyncio.create_task(_send(tab))
        try:
            self._ask(_Asked(tab, None))
            async for raw in connection:
                if not await self._take(tab, raw):
                    return
        finally:
            self._drop(tab)
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sender

    async def _take(self, tab: _Tab, raw: str | bytes) -> bool:
        """Take a message of a tab; False if it was closed for it."""
        if raw == '{"do":"stop"}':
            self._session.stop.set()
            return True
        try:
            job = parse_job(raw, self._session.verbs)
        except NotUnderstoodError as error:
            await tab.connection.close(_NOT_UNDERSTOOD, str(error))
            return False
        except InputError as error:
            self._put(tab, _note(str(error)))
            return True
        if job.do in self._session.urgent:
            if not tab.urges:  # else it waits already
                tab.urges = True
                self._queue(_Asked(tab, job), urgent=True)
        elif self._waiting >= MOST_JOBS:
            self._put(tab, _note("too much is waiting to be done; try again"))
        else:
            self._ask(_Asked(tab, job))
        return True

    def _ask(self, asked: _Asked) -> None:
        self._waiting += asked.tab is not None and asked.job is not None
        self._queue(asked)

    def _queue(self, asked: _Asked | None, *, urgent: bool = False) -> None:
        self._jobs.put((0 if urgent else 1, next(self._numbers), asked))

    def _work(self) -> None:
        """What the simulation's thread does."""
        try:
            while (asked := self._jobs.get()[2]) is not None:
                self._do(asked)
        except BaseException as error:  # the verb raises it again: nothing is hidden
            self.broken = error
            self._in_loop(self.ended.set)

    def _do(self, asked: _Asked) -> None:
        if asked.job is None:
            self._in_loop(self._greet, asked.tab, self._session.greet())
            return

        def post(message: bytes, *, everyone: bool = True) -> None:
            self._in_loop(self._deliver, None if everyone else asked.tab, message)

        self._session.stop.clear()
        urgent = asked.job.do in self._session.urgent
        if asked.tab is not None and urgent:
            # before it is done, not after: who says it again has seen what it did, and means more
            asked.tab.urges = False
        try:
            self._session.do(asked.job, post)
        except WarpDeformError as error:
            post(_note(str(error)), everyone=False)
        if asked.tab is not None and not urgent:
            self._in_loop(self._done)

    def _in_loop(self, call: Callable[..., Any], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody listens any more
            self._loop.call_soon_threadsafe(call, *arguments)

    def _done(self) -> None:
        self._waiting -= 1

    def _greet(self, tab: _Tab, messages: list[bytes]) -> None:
        if tab in self._tabs:
            tab.greeted = True
            for message in messages:
                self._put(tab, message)

    def _deliver(self, tab: _Tab | None, message: bytes) -> None:
        # a tab that is not greeted yet will be by the state that this message leads to
        for each in [tab] if tab else [t for t in self._tabs if t.greeted]:
            self._put(each, message)

    def _put(self, tab: _Tab, message: bytes) -> None:
        """Queue a message; a tab that does not read is cut off, and greeted anew if it returns."""
        if tab not in self._tabs:
            return
        try:
            tab.waiting.put_nowait(message)
        except asyncio.QueueFull:
            self._drop(tab)
            tab.connection.transport.abort()

    def _drop(self, tab: _Tab) -> None:
        with contextlib.suppress(ValueError):
            self._tabs.remove(tab)


async def _send(tab: _Tab) -> None:
    while True:
        await tab.connection.send(await tab.waiting.get())
        tab.waiting.task_done()


def _note(text: str) -> bytes:
    return pack("note", text=text)


def listen(port: int) -> socket.socket:
    """A socket bound to 127.0.0.1; port 0 takes any that is free.

    Raises:
        InputError: the port is taken, or not allowed.
    """
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind(("127.0.0.1", port))
        bound.listen()
    except OSError as error:
        bound.close()
        raise InputError(
            f"port {port} of 127.0.0.1 cannot be used ({error.strerror}); choose another --port, "
            "or none for any that is free"
        ) from error
    return bound


def check_websockets() -> None:
    """Raise InputError unless the extra is installed."""
    try:
        import websockets.asyncio.server  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"the page needs websockets 16 or later: {install_extra('page')}"
        ) from error


@contextlib.asynccontextmanager
async def serving(session: Session, bound: socket.socket) -> AsyncIterator[Served]:
    """Serve a session on a socket of `listen`."""
    from websockets.asyncio.server import serve

    access = Access(bound.getsockname()[1], files={**FILES, **session.files})
    served = Served(session, access)
    async with serve(
        served.handle,
        sock=bound,
        process_request=served.request,
        max_size=MOST_BYTES,
        max_queue=4,
        compression=None,
        server_header=None,
    ):
        try:
            yield served
        finally:
            await served.close()


def serve_until_interrupted(
    session: Session, bound: socket.socket, *, browser: Callable[[str], object] | None = None
) -> None:
    """Serve a session until Ctrl-C, or a signal to end; prints the address on stderr.

    Args:
        browser: is called with the address once it is served
    """
    asyncio.run(_until_interrupted(session, bound, browser))


async def _until_interrupted(
    session: Session, bound: socket.socket, browser: Callable[[str], object] | None
) -> None:
    async with serving(session, bound) as served:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, served.ended.set)
        print(f"open {served.access.address}   (Ctrl-C ends it)", file=sys.stderr, flush=True)
        if browser is not None:
            browser(served.access.address)
        await served.ended.wait()
    if served.broken is not None:
        raise served.broken
