"""Who is connected to the emulator, and from where it may be reached."""

from __future__ import annotations

import ipaddress
import socket

__all__ = ["Client", "is_loopback", "send"]


class Client:
    """One connected client: its TCP socket, and UDP once it has named its port.

    Attributes:
        tcp: where its commands come from
        udp: where it is sent states, and answers them
        udp_address: where to; None until it has said
    """

    def __init__(self, tcp: socket.socket, address: tuple[str, int], host: str) -> None:
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.tcp = tcp
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((host, 0))
        self._address = address[0]
        self.udp_address: tuple[str, int] | None = None

    def connect_udp(self, port: int) -> None:
        """Take the port on which it expects states."""
        self.udp_address = (self._address, port)

    def send_state(self, datagram: bytes) -> None:
        """Send a state, if it has said where to."""
        if self.udp_address is not None:
            self.udp.sendto(datagram, self.udp_address)

    def close(self) -> None:
        """Close both sockets."""
        self.tcp.close()
        self.udp.close()


def send(tcp: socket.socket, frame: bytes) -> None:
    """Send a reply that was not asked for just now."""
    try:
        tcp.sendall(frame)
    except OSError:
        pass  # the client has gone; reading from it will say so and clean up


def is_loopback(host: str) -> bool:
    """Return whether an address is of this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return False
