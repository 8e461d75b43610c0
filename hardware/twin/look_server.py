"""What an emulated robot's chain looks like, told to another process: the twin's camera sees by it.

`warp-deform franka emulate --chain SEED` serves it beside the two ports of the robot. It is a line
of JSON and nothing else; only addresses of this machine are served or asked.
"""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
from collections.abc import Callable

import numpy as np

from warp_deform.errors import InputError

from ..cameras.camera import CameraError
from ..emulator.world import Contact, Hand
from ..support.closing import Closing
from ..support.json_file import read_numbers, require
from .twin import CableTwin, TwinLook

__all__ = ["LOOK_PORT", "LookServer", "WatchedTwin", "remote_look"]

LOOK_PORT = 1340
"""Beside the robot's 1337 and the hand's 1338."""
_TIMEOUT = 5.0  # [s]
_MOST_BYTES = 2**20


class WatchedTwin(CableTwin):
    """A twin that may be looked at from another thread while it moves."""

    _busy = threading.RLock()

    def step(self, hand: Hand) -> Contact:
        """See `CableTwin.step`."""
        with self._busy:
            return super().step(hand)

    def look(self) -> TwinLook:
        """See `CableTwin.look`."""
        with self._busy:
            return super().look()


class LookServer(Closing):
    """Answers every connection with what there is to see, from a thread of its own.

    Args:
        look: tells what there is to see
        host: an address of this machine's loopback
        port: 0 takes any that is free

    Raises:
        InputError: another address, or one that is taken
    """

    def __init__(
        self, look: Callable[[], TwinLook], *, host: str = "127.0.0.1", port: int = LOOK_PORT
    ) -> None:
        _check_loopback(host)
        self._look = look
        try:
            self._socket = socket.create_server((host, port))
        except OSError as error:
            raise InputError(f"{host}:{port} cannot be served: {error.strerror}") from error
        self.port: int = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return  # closed
            with connection:
                try:
                    connection.settimeout(_TIMEOUT)
                    connection.sendall(_line(self._look()))
                except OSError:
                    continue  # whoever asked has gone

    def close(self) -> None:
        """Serve no more."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts
        except OSError:
            pass  # closed before
        self._socket.close()


def remote_look(host: str, *, port: int = LOOK_PORT) -> TwinLook:
    """Return what there is to see in the emulator at `host`.

    Raises:
        InputError: not an address of this machine
        CameraError: nobody answers there, or something else does
    """
    _check_loopback(host)
    try:
        with socket.create_connection((host, port), timeout=_TIMEOUT) as connection:
            data = b""
            while part := connection.recv(65536):
                data += part
                if len(data) > _MOST_BYTES:
                    break
    except OSError as error:
        raise CameraError(
            f"no simulated chain at {host}:{port} ({error}); start `warp-deform franka emulate "
            f"--host {host} --chain 0`"
        ) from error
    what = f"the answer of {host}:{port}"
    try:
        record = json.loads(data)
        return TwinLook(
            read_numbers(record, "beads", (-1, 3), what=what),
            read_numbers(record, "base_T_tcp", (4, 4), what=what),
            float(require(record, "gripper_width", float, what=what)),
            tuple(int(i) for i in require(record, "held", list, what=what)),
        )
    except ValueError as error:
        raise CameraError(f"{what} is no chain; something else listens there") from error


def _line(look: TwinLook) -> bytes:
    record = {
        "beads": np.asarray(look.beads).tolist(),
        "base_T_tcp": np.asarray(look.base_T_tcp).tolist(),
        "gripper_width": float(look.gripper_width),
        "held": list(look.held),
    }
    return json.dumps(record, allow_nan=False).encode() + b"\n"


def _check_loopback(host: str) -> None:
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if not local:
        raise InputError(
            f"{host} is not an address of this machine, 127.x.y.z; the simulated camera sees "
            "emulated robots alone"
        )
