"""Who is connected to a port of the emulator, who waits to be, and from where it may be reached.

Nothing here blocks, and nothing grows without bound: a connection that does not say what it is,
does not read what it is told, or speaks another language is dropped.
"""

from __future__ import annotations

import ipaddress
import socket
import struct
import time
from collections.abc import Iterator

from .protocol import Request, Stream

__all__ = ["Client", "Port", "is_loopback"]

# Connections that may wait to be let in at once; one more pushes out the one that came first.
MOST_WAITING = 8
# A client says who it is in its first message, at once; a connection that does not is dropped [s].
HELLO_WAIT = 5.0
# Replies that may lie unread: some model libraries of 20 kB [bytes].
MOST_UNSENT = 1 << 20
# Of what one client sends, so much is read before others have their turn [bytes].
_CHUNK, _CHUNKS = 4096, 16


class Client:
    """One connection: its TCP socket, and UDP once it has said its port.

    Attributes:
        tcp: where its commands come from
        udp: where it is sent states, and answers them; None until it has said where to
        turned_away: it was told that its version is another; it has nothing more to say
        lost: it cannot be written to any more
    """

    def __init__(self, tcp: socket.socket, stream: Stream, *, since: float) -> None:
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.tcp = tcp
        self.udp: socket.socket | None = None
        self.turned_away = self.lost = False
        self.since = since
        self._stream = stream
        self._unsent = b""

    @property
    def waits_to_be_written(self) -> bool:
        """Whether a part of a reply still waits for the client to read."""
        return bool(self._unsent)

    def connect_udp(self, port: int) -> None:
        """Exchange datagrams with that port of the client, and with nobody else.

        Raises:
            OSError: the client has gone
            ValueError: no datagram can be sent there
        """
        if port == 0:
            raise ValueError("no datagram can be sent to port 0")
        host, (peer, _) = self.tcp.getsockname()[0], self.tcp.getpeername()
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.udp.bind((host, 0))
        # The system drops what comes from any other address or port.
        self.udp.connect((peer, port))

    def requests(self) -> Iterator[Request]:
        """Yield the requests that have arrived, and notice at once when they were the last.

        Raises:
            ConnectionError: the client has gone, or does not read
            ValueError: what arrived is no request
        """
        for _ in range(_CHUNKS):
            try:
                received = self.tcp.recv(_CHUNK)
            except BlockingIOError:
                return
            if not received:
                raise ConnectionResetError("the client has closed the connection")
            for request in self._stream.requests(received):
                if self.lost:
                    raise ConnectionAbortedError("the client does not read")
                yield request

    def reply(self, request: Request, status: int, payload: bytes = b"") -> None:
        """Answer a request, now or as soon as the client reads."""
        self._unsent += self._stream.reply(request.command, request.command_id, status, payload)
        self.write()

    def write(self) -> None:
        """Send what waits, as much as goes; a client that has gone, or never reads, is lost."""
        try:
            self._unsent = self._unsent[self.tcp.send(self._unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self.lost = True
        self.lost = self.lost or len(self._unsent) > MOST_UNSENT

    def datagram(self) -> bytes:
        """Return a datagram that has arrived from the client; empty if there is none after all."""
        assert self.udp is not None
        try:
            return self.udp.recv(_CHUNK)
        except OSError:  # the client's port is closed: its connection will say so
            return b""

    def send_state(self, datagram: bytes) -> None:
        """Send a state, if the client has said where to; one that does not get through is lost."""
        if self.udp is not None:
            try:
                self.udp.send(datagram)
            except OSError:
                pass

    def close(self) -> None:
        """Close both sockets."""
        self.tcp.close()
        if self.udp is not None:
            self.udp.close()


class Port:
    """A TCP port: who was let in, one at a time, and who waits in front of it.

    Attributes:
        client: who was let in; None while there is nobody
        waiting: connections that have not said who they are
        listener: the listening socket

    Raises:
        OSError: something already listens there
    """

    def __init__(self, host: str, number: int, *, command: str, status: str) -> None:
        self._codes = {"command": command, "status": status}
        self.client: Client | None = None
        self.waiting: list[Client] = []
        self.listener = socket.socket()
        try:
            self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.listener.bind((host, number))
            self.listener.setblocking(False)
            self.listener.listen()
        except OSError:
            self.listener.close()
            raise

    @property
    def connections(self) -> list[Client]:
        """The client, if any, before those who wait."""
        return ([self.client] if self.client else []) + self.waiting

    def accept(self) -> None:
        """Take a new connection; it waits until it has said who it is, if there is no client."""
        try:
            tcp, _ = self.listener.accept()
        except OSError:
            return  # it has gone again
        if self.client is not None:
            tcp.close()
            return
        try:
            self.waiting.append(Client(tcp, Stream(**self._codes), since=time.perf_counter()))
        except OSError:
            tcp.close()
        if len(self.waiting) > MOST_WAITING:
            self.drop(self.waiting[0])

    def let_in(self, connection: Client) -> None:
        """Make a connection the client; the others that wait came too late."""
        self.waiting.remove(connection)
        self.client = connection
        for late in self.waiting:
            # The vendor's client takes an orderly end for silence, and waits for a minute.
            late.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            late.close()
        self.waiting.clear()

    def overdue(self, now: float) -> list[Client]:
        """Return who is given up at time `now` [s]: who waits too long, or cannot be reached."""
        late = [c for c in self.waiting if now - c.since > HELLO_WAIT]
        return late + [c for c in self.connections if c.lost and c not in late]

    def drop(self, connection: Client) -> bool:
        """Close a connection; returns whether it was the client."""
        connection.close()
        if connection in self.waiting:
            self.waiting.remove(connection)
        if connection is not self.client:
            return False
        self.client = None
        return True

    def close(self) -> None:
        """Close every socket."""
        for connection in self.connections:
            connection.close()
        self.listener.close()


def is_loopback(host: str) -> bool:
    """Return whether an address is of this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return False
