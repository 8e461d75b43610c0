"""The emulator in a process of its own, and the handle by which its owner talks to it.

It has to be another process: the vendor's client holds Python's interpreter lock while it waits for
the robot.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from warp_deform.errors import WarpDeformError

from ..support.closing import Closing
from .model_library import model_library
from .server import AddressTaken, EmulatorConfig, FciServer
from .world import TableWorld, World

START_TIMEOUT = 60.0  # [s], for a new process on a busy machine
ANSWER_TIMEOUT = 10.0  # [s]


class EmulatorFailed(WarpDeformError):
    """The emulator's process did not start, or answers no more; the message says what to do."""


def serve_emulator(config: EmulatorConfig, *, world: World | None = None) -> None:
    """Serve in this process until it is interrupted.

    Raises:
        AddressTaken: something already listens there
        CompilerMissing: there is no C compiler for the model library
    """
    FciServer(config, model=model_library(), world=world or TableWorld()).serve()


def _serve(
    config: EmulatorConfig, hosts: list[str], world: Callable[[], World], connection: Connection
) -> None:
    """Serve on the first of `hosts` that is free; tell the owner which, or why on none."""
    failure: WarpDeformError | None = None
    for host in hosts:
        try:
            settings = dataclasses.replace(config, host=host)
            server = FciServer(settings, model=model_library(), world=world())
        except AddressTaken as error:
            failure = error
        except WarpDeformError as error:
            failure = error
            break
        else:
            connection.send(host)
            server.serve(connection)
            return
    connection.send(failure)


class EmulatorProcess(Closing):
    """A running emulator; a context manager that ends it.

    Attributes:
        host: the address it listens on

    Close the vendor's client before the emulator.

    Args:
        config: how the emulator is set up
        world: makes the world in the emulator's process: a module's function or class
        free_host: instead of config.host take the first free address of 127.0.77.1 to
            127.0.77.254, so that several can run side by side
        start_timeout_s: time for the process and its world to start [s]

    Raises:
        EmulatorFailed: the process did not start
        AddressTaken: something already listens there
        CompilerMissing: there is no C compiler for the model library
    """

    def __init__(
        self,
        config: EmulatorConfig | None = None,
        *,
        world: Callable[[], World] = TableWorld,
        free_host: bool = False,
        start_timeout_s: float = START_TIMEOUT,
    ) -> None:
        config = config or EmulatorConfig()
        hosts = [f"127.0.77.{i}" for i in range(1, 255)] if free_host else [config.host]
        context = multiprocessing.get_context("spawn")
        self._control, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(config, hosts, world, theirs), daemon=True
        )
        self._process.start()
        theirs.close()
        answer: str | WarpDeformError
        try:
            answer = EmulatorFailed(
                f"the emulator's process did not start in {start_timeout_s:g} s; give it longer "
                "(start_timeout_s), or look what keeps the machine busy"
            )
            if self._control.poll(start_timeout_s):
                answer = self._control.recv()
        except EOFError:
            answer = EmulatorFailed(
                "the emulator's process ended before it served; what it printed says why, and so "
                "does `warp-deform franka emulate` in a shell"
            )
        if isinstance(answer, WarpDeformError):
            self.kill()
            raise answer
        self.host = answer

    def _ask(self, verb: str, /, *, timeout_s: float = ANSWER_TIMEOUT, **arguments: Any) -> Any:
        try:
            self._control.send((verb, arguments))
            if not self._control.poll(timeout_s):
                raise EmulatorFailed(
                    f"the emulator did not answer {verb!r} in {timeout_s:g} s; give it longer "
                    "(timeout_s), or close it and start another"
                )
            answer = self._control.recv()
        except (EOFError, OSError) as error:
            raise EmulatorFailed(
                "the emulator's process has ended; what it printed says why: start another"
            ) from error
        if isinstance(answer, WarpDeformError):
            raise answer
        return answer

    def snapshot(self) -> dict[str, Any]:
        """Return q [rad] (7,), base_T_tcp (4, 4) [m], gripper_width [m], mode, ticks, missed
        and sim_seconds, as they truly are in the emulator.
        """
        answer: dict[str, Any] = self._ask("snapshot")
        return answer

    def place(self, q: np.ndarray) -> None:
        """Put the standing arm at joint positions [rad] (7,), as if guided by hand."""
        self._ask("place", q=q)

    def inject_reflex(self, name: str = "joint_reflex", *, after_ticks: int = 300) -> None:
        """Abort the motion by reflex `name` once `after_ticks` more milliseconds were commanded."""
        self._ask("reflex", name=name, after_ticks=after_ticks)

    def user_stop(self, pressed: bool = True) -> None:
        """Press or release the user stop."""
        self._ask("user_stop", pressed=pressed)

    def call_world(
        self, method: str, /, *, timeout_s: float = ANSWER_TIMEOUT, **arguments: Any
    ) -> Any:
        """Call a method of the world, between two time steps; returns what it returns.

        While it runs, the robot sends no states: a client that reads gives up after 1 s.
        """
        return self._ask("world", timeout_s=timeout_s, method=method, arguments=arguments)

    def kill(self) -> None:
        """End the process as a power cut would."""
        self._process.kill()
        self._process.join()
        self._control.close()

    def close(self) -> None:
        """End the process in an orderly way; harmless when it has already ended."""
        if self._control.closed:
            return
        if self._process.is_alive():
            try:
                self._ask("stop")
            except EmulatorFailed:
                pass  # it is going, or gone: the join below sees to both
            self._process.join(2.0)
        self.kill()
