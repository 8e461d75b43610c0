"""A client of the emulator that writes its own bytes: right ones, and wrong ones."""

from __future__ import annotations

import socket
import struct

import numpy as np

from hardware.emulator.protocol import (
    GRIPPER_COMMAND_PORT,
    GRIPPER_VERSION,
    ROBOT_COMMAND,
    ROBOT_COMMAND_PORT,
    ROBOT_STATE,
    ROBOT_VERSION,
    ControllerMode,
    GeneratorMode,
    GripperCommand,
    GripperStatus,
    MoveStatus,
    RobotCommand,
    RobotMode,
)
from hardware.support.closing import Closing

PATIENCE = 30.0  # [s], on a busy machine
DEVIATIONS = struct.pack("<6d", *[10.0, 3.12, 2 * np.pi] * 2)
# A joint's velocity of a short motion, from rest to rest [rad/s].
BUMP = 0.05 * np.sin(np.linspace(0.0, np.pi, 101)) ** 2


class Wire(Closing):
    """A connection to the robot's port, or to the gripper's."""

    def __init__(self, host: str, *, gripper: bool = False) -> None:
        port = GRIPPER_COMMAND_PORT if gripper else ROBOT_COMMAND_PORT
        self._codes = ("<HII", "<H") if gripper else ("<III", "<B")
        self._version = GRIPPER_VERSION if gripper else ROBOT_VERSION
        self.tcp = socket.create_connection((host, port), timeout=PATIENCE)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 0))
        self.udp.settimeout(PATIENCE)
        self._next_id = 0
        self.message_id = 0

    def close(self) -> None:
        self.tcp.close()
        self.udp.close()

    def send(self, command: int, body: bytes = b"", *, size: int | None = None) -> int:
        """Send a request, of another size in its header if so given; returns its number."""
        header = struct.Struct(self._codes[0])
        self._next_id += 1
        length = header.size + len(body) if size is None else size
        self.tcp.sendall(header.pack(command, self._next_id, length) + body)
        return self._next_id

    def reply(self) -> tuple[int, int, bytes]:
        """Return the next reply: to which request, its status, what follows."""
        header, status = (struct.Struct(code) for code in self._codes)
        _, number, size = header.unpack(self._read(header.size))
        body = self._read(size - header.size)
        return number, status.unpack_from(body)[0], body[status.size :]

    def _read(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            part = self.tcp.recv(size - len(received))
            if not part:
                raise ConnectionResetError("closed")
            received += part
        return received

    def ask(self, command: int, body: bytes = b"") -> int:
        """Send a request; returns the status of its reply."""
        number = self.send(command, body)
        answered, status, _ = self.reply()
        assert answered == number
        return status

    def dropped(self) -> bool:
        """Return whether the server closes this connection without another word."""
        try:
            return self.tcp.recv(1) == b""
        except ConnectionResetError:
            return True

    def connect(self, *, version: int | None = None) -> int:
        """Say who this is; returns the status of the reply."""
        version = self._version if version is None else version
        return self.ask(0, struct.pack("<2H", version, self.udp.getsockname()[1]))

    def state(self) -> np.void:
        """Return the next state; commands answer it from then on."""
        datagram, self.server = self.udp.recvfrom(4096)
        state = np.frombuffer(datagram, ROBOT_STATE)[0]
        self.message_id = int(state["message_id"])
        return state

    def command(self, *, message_id: int | None = None, **fields: object) -> bytes:
        """Return the bytes of a motion command that answers the last state."""
        command = np.zeros((), ROBOT_COMMAND)
        command["message_id"] = self.message_id if message_id is None else message_id
        for name, value in fields.items():
            command[name] = value
        return command.tobytes()

    def answer(self, **fields: object) -> np.void:
        """Answer the last state; returns the state after it.

        Until a motion has begun the robot may repeat its state before the answer reaches it; then
        that one is answered.
        """
        while True:
            self.udp.sendto(self.command(**fields), self.server)
            state = self.state()
            begun = state["control_command_success_rate"] > 0.0
            if begun or state["robot_mode"] != RobotMode.MOVE:
                return state

    def move(
        self,
        generator: GeneratorMode = GeneratorMode.JOINT_VELOCITY,
        controller: ControllerMode = ControllerMode.JOINT_IMPEDANCE,
    ) -> np.void:
        """Start a motion; returns its first state."""
        body = struct.pack("<2I", controller, generator - 1) + DEVIATIONS
        assert self.ask(RobotCommand.MOVE, body) == MoveStatus.MOTION_STARTED
        state = self.state()
        while state["robot_mode"] != RobotMode.MOVE:
            state = self.state()
        return state


def serves(host: str) -> None:
    """Assert that a well-behaved client finds both ports as they should be."""
    with Wire(host) as robot, Wire(host, gripper=True) as gripper:
        assert (robot.connect(), gripper.connect()) == (0, 0)
        assert robot.ask(RobotCommand.AUTOMATIC_ERROR_RECOVERY) == 0
        q = robot.move()["q"].copy()
        for speed in BUMP:
            state = robot.answer(dq_c=[speed, *[0.0] * 6])
        assert state["q"][0] - q[0] > 2e-3 and np.isfinite(state["O_T_EE"]).all()
        robot.udp.sendto(robot.command(motion_generation_finished=True), robot.server)
        assert robot.reply()[1] == MoveStatus.SUCCESS
        for width in (0.03, 0.04):
            body = struct.pack("<2d", width, 0.1)
            assert gripper.ask(GripperCommand.MOVE, body) == GripperStatus.SUCCESS
