"""The two ports, the clock, and one thread that serves everything.

Lock-step mode: the next state is sent when the client has answered the last one, so simulated time
is what the client's commands make of it, a run gives the same bits every time, and it goes as fast
as the two processes can. Between motions the client gets states at 1 kHz, but no simulated time
passes. Paced mode: 1 ms of simulated time every millisecond, whatever the client does.

One client at a time on each port; a second is turned away. What a client sends in error costs it an
answer that says so, or its connection, and nobody else anything.
"""

from __future__ import annotations

import functools
import math
import select
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from warp_deform.errors import InputError, WarpDeformError

from ..arm.panda import GRIPPER_MAX_WIDTH, HOME_Q
from .clients import Client, Port, is_loopback
from .gripper import Gripper
from .model_library import ModelLibrary
from .motion_limits import DT
from .protocol import (
    GRIPPER_COMMAND_PORT,
    GRIPPER_VERSION,
    ROBOT_COMMAND,
    ROBOT_COMMAND_PORT,
    ROBOT_VERSION,
    Request,
    pack_gripper_state,
)
from .robot import Answer, EmulatedRobot
from .world import Contact, Hand, World

__all__ = ["AddressTaken", "EmulatorConfig", "FciServer"]

CONNECT = 0  # the first command on either port
# A client leaves the first state of a motion unanswered: go on after this [s].
FIRST_STATE_WAIT = 2e-3
# For the second it may still be starting; repeating states too early would cost determinism [s].
START_WAIT = 0.2
# A client that is silent for so long in the middle of a lock-step motion hangs [s]. Patience is
# free: no simulated time passes, one that has ended is noticed at once by its closed connection,
# and a busy machine may well keep a process waiting for a second.
SILENCE = 20.0
GRIPPER_STATE_PERIOD = 0.01  # [s]
# How far behind the wall clock paced time may fall before it stops trying to catch up [s].
MAX_LAG = 0.01


class AddressTaken(WarpDeformError):
    """Another server already listens on the emulator's address."""


class Control(Protocol):
    """A channel on which the emulator's owner asks questions: a `multiprocessing` connection."""

    def fileno(self) -> int: ...
    def recv(self) -> Any: ...
    def send(self, obj: Any) -> None: ...


@dataclass(frozen=True, kw_only=True)
class EmulatorConfig:
    """Where the emulator listens, how its time runs and how the arm stands at first."""

    host: str = "127.0.0.1"
    """Address of this machine's loopback to listen on, 127.x.y.z: it asks nobody for a password. On
    Linux all of them work, so several emulators run side by side."""
    paced: bool = False
    """1 kHz by the wall clock, as a robot; default: lock-step, deterministic and fast."""
    q: tuple[float, ...] = HOME_Q
    """Joint positions at the start [rad]."""
    gripper_width: float = GRIPPER_MAX_WIDTH
    """Opening of the fingers at the start [m]."""
    version: int = ROBOT_VERSION
    """Version that the robot port claims to speak; another shows what a mismatch looks like."""

    def __post_init__(self) -> None:
        if not is_loopback(self.host):
            raise InputError(
                f"host: {self.host!r} is not an address of this machine alone; the emulator takes "
                "commands from whoever reaches it: choose 127.0.0.1 to 127.255.255.254"
            )
        if len(self.q) != 7 or not all(math.isfinite(angle) for angle in self.q):
            raise InputError(f"q: seven finite joint positions [rad], not {self.q}")
        if not 0 <= self.version <= 0xFFFF:
            raise InputError(f"version: 0 to 65535, as two bytes hold, not {self.version}")
        if not 0.0 <= self.gripper_width <= GRIPPER_MAX_WIDTH:
            raise InputError(
                f"gripper_width: within 0 and {GRIPPER_MAX_WIDTH} m, not {self.gripper_width}"
            )


class FciServer:
    """The robot port, the gripper port, and what stands behind them.

    Args:
        config: address, pacing and start
        model: the compiled model library
        world: what surrounds the hand

    Raises:
        AddressTaken: something already listens there
    """

    def __init__(self, config: EmulatorConfig, *, model: ModelLibrary, world: World) -> None:
        self._config = config
        self._world = world
        self.robot = EmulatedRobot(model, q=np.array(config.q))
        self.gripper = Gripper(width=config.gripper_width)
        self._contact = Contact()
        self.sim_seconds = 0.0
        self._message_id = 0
        self._command: bytes | None = None
        self._states_unanswered = 0
        self._deadline = 0.0
        self._next_tick = self._next_gripper_state = time.perf_counter()
        self._running = True
        self._ports: list[Port] = []
        try:
            for number, codes in ((ROBOT_COMMAND_PORT, "IB"), (GRIPPER_COMMAND_PORT, "HH")):
                self._ports.append(Port(config.host, number, command=codes[0], status=codes[1]))
        except OSError as error:
            self.close()
            raise AddressTaken(
                f"cannot listen on {config.host}: {error.strerror}; stop the other emulator or "
                "choose another --host, such as 127.0.0.2"
            ) from error
        self._robot_port, self._gripper_port = self._ports

    def close(self) -> None:
        """Close every socket."""
        for port in self._ports:
            port.close()

    def serve(self, control: Control | None = None) -> None:
        """Serve until `control` says "stop" or closes; without one, for ever."""
        try:
            while self._running:
                self._receive(control)
                self._advance(time.perf_counter())
        finally:
            self.close()

    # What arrives.

    def _receive(self, control: Control | None) -> None:
        # In this order: who leaves makes room for who comes.
        acts: dict[Any, Callable[[], None]] = {}
        unwritten: dict[Any, Client] = {}
        if control is not None:
            acts[control] = functools.partial(self._answer, control)
        for port in self._ports:
            for connection in port.connections:
                acts[connection.tcp] = functools.partial(self._read, port, connection)
                if connection.waits_to_be_written:
                    unwritten[connection.tcp] = connection
        robot = self._robot_port.client
        if robot is not None and robot.udp is not None:
            acts[robot.udp] = functools.partial(self._take_command, robot)
        for port in self._ports:
            acts[port.listener] = port.accept
        wait = max(self._wake() - time.perf_counter(), 0.0)
        readable, writable, _ = select.select(list(acts), list(unwritten), [], wait)
        for source in writable:
            unwritten[source].write()
        ready = set(readable)
        for source, act in acts.items():
            if source in ready:
                act()
        for port in self._ports:
            for connection in port.overdue(time.perf_counter()):
                self._drop(port, connection)

    def _wake(self) -> float:
        """When something has to be done even if nothing arrives, by the wall clock [s]."""
        if not self._config.paced:
            if self.robot.moving:
                return self._deadline
            if self.gripper.busy:
                return 0.0
        return self._next_tick

    def _take_command(self, client: Client) -> None:
        """Keep what answers the state that was sent last, and nothing else."""
        datagram = client.datagram()
        if len(datagram) == ROBOT_COMMAND.itemsize and self._command is None:
            if struct.unpack_from("<Q", datagram)[0] == self._message_id:
                self._command = datagram

    def _read(self, port: Port, connection: Client) -> None:
        """Obey what has come over TCP; whoever sends what is no request is dropped."""
        try:
            for request in connection.requests():
                if connection is not port.client:
                    self._greet(port, connection, request)
                elif port is self._robot_port:
                    self._obey_robot_request(connection, request)
                else:
                    self._obey_gripper_request(connection, request)
        except (OSError, ValueError):
            self._drop(port, connection)

    def _greet(self, port: Port, connection: Client, request: Request) -> None:
        """Let in who speaks the version of this port and comes first.

        Raises:
            OSError: the client has gone
            ValueError: this is no greeting
        """
        version = self._config.version if port is self._robot_port else GRIPPER_VERSION
        if request.command != CONNECT or len(request.body) != 4 or connection.turned_away:
            raise ValueError("whoever connects says so first, and once")
        claimed, udp_port = struct.unpack("<2H", request.body)
        connection.turned_away = claimed != version
        if not connection.turned_away:
            connection.connect_udp(udp_port)
            port.let_in(connection)
        connection.reply(request, int(connection.turned_away), struct.pack("<H", version))

    def _drop(self, port: Port, connection: Client) -> None:
        if not port.drop(connection):
            return
        if port is self._robot_port:
            self.robot.disconnect()
        else:
            self.gripper.abandon()

    def _obey_robot_request(self, client: Client, request: Request) -> None:
        was_moving = self.robot.moving
        for answer in self.robot.obey(request):
            client.reply(*answer)
        if self.robot.moving and not was_moving:
            self._command, self._states_unanswered = None, 0
            self._send_robot_state(time.perf_counter())

    def _obey_gripper_request(self, client: Client, request: Request) -> None:
        for ended, status in self.gripper.start(request):
            client.reply(ended, status)

    # What time brings.

    def _advance(self, now: float) -> None:
        if not self._config.paced and self.robot.moving:
            if self._command is None and now < self._deadline:
                return
            if self._command is None and self.robot.started:
                self._tell_robot(self.robot.lose_communication())
            self._simulate()
            self._send_robot_state(now)
        elif not self._config.paced and self.gripper.busy:
            self._simulate()
        if now >= self._next_tick:
            self._next_tick = max(self._next_tick + DT, now - MAX_LAG)
            if self._config.paced:
                self._simulate()
            if self._config.paced or not self.robot.moving:
                self._send_robot_state(now)
        if now >= self._next_gripper_state:
            self._next_gripper_state = now + GRIPPER_STATE_PERIOD
            self._send_gripper_state()

    def _simulate(self) -> None:
        """Let one millisecond pass: arm, fingers, world."""
        datagram, self._command = self._command, None
        answered = datagram is not None
        self._tell_robot(self.robot.tick(datagram))
        if not self._config.paced and not answered and not self.gripper.busy:
            return  # the client had not begun yet, so no time has passed
        ended = self.gripper.step(DT, self._contact.object_width)
        arm = self.robot.arm
        self.sim_seconds += DT
        self._contact = self._world.step(
            Hand(arm.base_T_tcp, arm.twist[:3], self.gripper.width, self.gripper.closing, DT)
        )
        self._tell_robot(self.robot.feel(np.array(self._contact.wrench, dtype=np.float64)))
        if ended is not None and self._gripper_port.client is not None:
            self._send_gripper_state()
            self._gripper_port.client.reply(*ended)

    def _tell_robot(self, answer: Answer | None) -> None:
        """Send the reply that ends a motion; a state that shows the end goes before it."""
        if answer is not None and self._robot_port.client is not None:
            self._send_robot_state(time.perf_counter())
            self._robot_port.client.reply(*answer)

    def _send_robot_state(self, now: float) -> None:
        client = self._robot_port.client
        if client is None:
            return
        self._message_id += 1
        client.send_state(self.robot.state(self._message_id))
        self._states_unanswered += 1
        wait = FIRST_STATE_WAIT if self._states_unanswered == 1 else START_WAIT
        self._deadline = now + (SILENCE if self.robot.started else wait)

    def _send_gripper_state(self) -> None:
        client = self._gripper_port.client
        if client is not None:
            gripper = self.gripper
            client.send_state(
                pack_gripper_state(
                    self._message_id,
                    width=gripper.width,
                    max_width=GRIPPER_MAX_WIDTH,
                    grasped=gripper.grasped,
                )
            )

    # What the owner asks.

    def _answer(self, control: Control) -> None:
        try:
            name, arguments = control.recv()
        except EOFError:
            self._running = False
            return
        verbs: dict[str, Callable[..., Any]] = {
            "snapshot": self._snapshot,
            "place": self._place,
            "reflex": self.robot.schedule_reflex,
            "user_stop": self._user_stop,
            "world": self._call_world,
            "stop": self._stop,
        }
        try:
            answer = verbs[name](**arguments)
        except WarpDeformError as error:
            answer = error
        control.send(answer)

    def _stop(self) -> None:
        self._running = False

    def _snapshot(self) -> dict[str, Any]:
        robot = self.robot
        return {
            "q": robot.arm.q,
            "base_T_tcp": robot.arm.base_T_tcp,
            "gripper_width": self.gripper.width,
            "mode": robot.mode.name.lower(),
            "ticks": robot.ticks,
            "missed": robot.missed,
            "sim_seconds": self.sim_seconds,
        }

    def _place(self, q: np.ndarray) -> None:
        if self.robot.moving:
            raise InputError("place: the arm is moving; wait until it stands still")
        self.robot.arm.place(q)

    def _user_stop(self, pressed: bool) -> None:
        self._tell_robot(self.robot.user_stop(pressed))

    def _call_world(self, method: str, arguments: dict[str, Any]) -> Any:
        if not callable(getattr(self._world, method, None)):
            raise InputError(f"call_world: {type(self._world).__name__} has no method {method!r}")
        return getattr(self._world, method)(**arguments)
