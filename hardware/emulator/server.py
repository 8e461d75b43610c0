"""The two ports, the clock, and one thread that serves everything.

Lock-step mode: the next state is sent when the client has answered the last one, so simulated time
is what the client's commands make of it, a run gives the same bits every time, and it goes as fast
as the two processes can. Between motions the client gets states at 1 kHz, but no simulated time
passes. Paced mode: 1 ms of simulated time every millisecond, whatever the client does.

One client at a time on each port; a second is turned away.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from warp_deform.errors import InputError, WarpDeformError

from ..panda_arm import GRIPPER_MAX_WIDTH, HOME_Q
from .arm import DT
from .clients import Client, is_loopback, send
from .gripper import Gripper
from .model_library import ModelLibrary
from .protocol import (
    GRIPPER_COMMAND_PORT,
    GRIPPER_VERSION,
    ROBOT_COMMAND_PORT,
    ROBOT_VERSION,
    GripperCommand,
    Request,
    Stream,
    pack_gripper_state,
)
from .robot import EmulatedRobot
from .world import Contact, Hand, World

__all__ = ["AddressTaken", "EmulatorConfig", "FciServer"]

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
        if len(self.q) != 7:
            raise InputError(f"q: seven joint positions [rad], not {len(self.q)}")
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
        self.robot = EmulatedRobot(model, q=np.array(config.q), version=config.version)
        self.gripper = Gripper(width=config.gripper_width)
        self._contact = Contact()
        self.sim_seconds = 0.0
        self._message_id = 0
        self._listeners: dict[socket.socket, str] = {}
        self._clients: dict[str, Client] = {}
        self._gripper_stream = Stream(command="H", status="H")
        self._command: bytes | None = None
        self._states_unanswered = 0
        self._deadline = 0.0
        self._next_tick = self._next_gripper_state = time.perf_counter()
        self._running = True
        try:
            for name, port in (("robot", ROBOT_COMMAND_PORT), ("gripper", GRIPPER_COMMAND_PORT)):
                self._listen(name, port)
        except OSError as error:
            self.close()
            raise AddressTaken(
                f"cannot listen on {config.host}: {error.strerror}; stop the other emulator or "
                "choose another --host, such as 127.0.0.2"
            ) from error

    def _listen(self, name: str, port: int) -> None:
        listener = socket.socket()
        self._listeners[listener] = name
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((self._config.host, port))
        listener.listen()

    def close(self) -> None:
        """Close every socket."""
        for client in self._clients.values():
            client.close()
        for listener in self._listeners:
            listener.close()

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
        sources: list[Any] = [*self._listeners]
        for client in self._clients.values():
            sources += [client.tcp, client.udp]
        if control is not None:
            sources.append(control)
        wait = max(self._wake() - time.perf_counter(), 0.0)
        ready = select.select(sources, [], [], wait)[0]
        # Who leaves makes room for who comes.
        for source in sorted(ready, key=lambda source: source in self._listeners):
            if source is control:
                self._answer(control)
            elif source in self._listeners:
                self._accept(source)
            else:
                self._read(source)

    def _wake(self) -> float:
        """When something has to be done even if nothing arrives, by the wall clock [s]."""
        if not self._config.paced:
            if self.robot.moving:
                return self._deadline
            if self.gripper.busy:
                return 0.0
        return self._next_tick

    def _accept(self, listener: socket.socket) -> None:
        tcp, address = listener.accept()
        name = self._listeners[listener]
        if name in self._clients:
            tcp.close()
            return
        self._clients[name] = Client(tcp, address, self._config.host)

    def _read(self, source: socket.socket) -> None:
        for name, client in list(self._clients.items()):
            if source is client.udp:
                datagram = client.udp.recv(65536)
                if name == "robot":
                    self._command = datagram
            elif source is client.tcp:
                self._read_tcp(name, client)

    def _read_tcp(self, name: str, client: Client) -> None:
        handle = self._robot_requests if name == "robot" else self._gripper_requests
        try:
            received = client.tcp.recv(65536)
            if received:
                handle(client, received)
                return
        except (OSError, ValueError, struct.error):
            pass  # a connection reset, or bytes that are no request: the client is dropped
        client.close()
        del self._clients[name]
        if name == "robot":
            self.robot.disconnect()
        else:
            self._gripper_stream = Stream(command="H", status="H")

    def _robot_requests(self, client: Client, received: bytes) -> None:
        was_moving = self.robot.moving
        replies, udp_port = self.robot.receive(received)
        client.tcp.sendall(replies)
        if udp_port is not None:
            client.connect_udp(udp_port)
        if self.robot.moving and not was_moving:
            self._command, self._states_unanswered = None, 0
            self._send_robot_state(time.perf_counter())

    def _gripper_requests(self, client: Client, received: bytes) -> None:
        for request in self._gripper_stream.requests(received):
            if request.command == GripperCommand.CONNECT:
                version, port = struct.unpack("<2H", request.body)
                accepted = version == GRIPPER_VERSION
                self._reply_gripper(
                    request, 0 if accepted else 1, struct.pack("<H", GRIPPER_VERSION)
                )
                if accepted:
                    client.connect_udp(port)
                continue
            for ended, status in self.gripper.start(request):
                self._reply_gripper(ended, status)

    def _reply_gripper(self, request: Request, status: int, payload: bytes = b"") -> None:
        client = self._clients.get("gripper")
        if client is not None:
            frame = self._gripper_stream.reply(request.command, request.command_id, status, payload)
            send(client.tcp, frame)

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
        if ended is not None:
            self._send_gripper_state()
            self._reply_gripper(*ended)

    def _tell_robot(self, reply: bytes) -> None:
        """Send a reply that ends a motion; a state that shows the end goes before it."""
        if reply and "robot" in self._clients:
            self._send_robot_state(time.perf_counter())
            send(self._clients["robot"].tcp, reply)

    def _send_robot_state(self, now: float) -> None:
        client = self._clients.get("robot")
        if client is None or client.udp_address is None:
            return
        self._message_id += 1
        client.send_state(self.robot.state(self._message_id))
        self._states_unanswered += 1
        wait = FIRST_STATE_WAIT if self._states_unanswered == 1 else START_WAIT
        self._deadline = now + (SILENCE if self.robot.started else wait)

    def _send_gripper_state(self) -> None:
        client = self._clients.get("gripper")
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
