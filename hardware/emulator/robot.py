"""The robot's side of the interface: what a state says, what a command does, and how motions end.

No sockets here: bytes in, bytes out, one call a tick. `server.py` decides when a tick is.
"""

from __future__ import annotations

import struct

import numpy as np

from warp_deform.errors import InputError

from .arm import Arm
from .model_library import ModelLibrary
from .protocol import (
    ERRORS,
    ROBOT_COMMAND,
    ROBOT_STATE,
    ROBOT_VERSION,
    ControllerMode,
    GeneratorMode,
    MoveStatus,
    Request,
    RobotCommand,
    RobotMode,
    Stream,
)

__all__ = ["EmulatedRobot"]

# Commands that may be missing in a row before the motion is aborted, as on the robot.
MAX_MISSED = 20
# Commands over which the success rate is counted.
RATE_WINDOW = 100
# How much contact is too much until the client says otherwise [N m], [N, N m].
DEFAULT_TORQUE_THRESHOLD, DEFAULT_FORCE_THRESHOLD = 20.0, 20.0
IDENTITY = np.eye(4).ravel()
REJECTED = 1  # of every command that only sets something: not possible now


class EmulatedRobot:
    """An arm behind the Franka Control Interface.

    Attributes:
        arm: the joints
        mode: what the robot is doing
        ticks: commands obeyed since the start
        missed: commands missing since the start
    """

    def __init__(self, model: ModelLibrary, *, q: np.ndarray, version: int = ROBOT_VERSION) -> None:
        self.arm = Arm(model, q=q)
        self.mode = RobotMode.IDLE
        self.ticks = self.missed = 0
        self._model = model
        self._version = version
        self._stream = Stream(command="I", status="B")
        self._state = np.zeros((), ROBOT_STATE)
        self._state["EE_T_K"] = self._state["NE_T_EE"] = IDENTITY
        self._state["F_T_NE"] = self.arm.F_T_EE
        self._state["m_ee"] = 0.73
        self._torque_threshold = np.full(7, DEFAULT_TORQUE_THRESHOLD)
        self._force_threshold = np.full(6, DEFAULT_FORCE_THRESHOLD)
        self._reflex: tuple[str, int] | None = None
        self._answered: list[bool] = []
        self._locked = False
        self._end_motion()

    def _end_motion(self) -> None:
        self._move: Request | None = None
        self.started = False
        self._generator, self._controller = GeneratorMode.IDLE, ControllerMode.OTHER
        self._missed_in_a_row = 0
        if self.mode == RobotMode.MOVE:
            self.mode = RobotMode.IDLE

    @property
    def moving(self) -> bool:
        """Whether a motion is in progress."""
        return self._move is not None

    def disconnect(self) -> None:
        """The client has gone: stop, and expect a new one."""
        self.arm.hold()
        self._end_motion()
        self._stream = Stream(command="I", status="B")

    def schedule_reflex(self, name: str, *, after_ticks: int) -> None:
        """Abort by reflex `name` when `after_ticks` more commands have been obeyed."""
        if name not in ERRORS:
            raise InputError(f"reflex: one of {', '.join(ERRORS)}, not {name!r}")
        self._reflex = (name, self.ticks + after_ticks)

    def user_stop(self, pressed: bool) -> bytes:
        """Press or release the user stop; returns what the client is told over TCP.

        Released, the state looks like any other, but motions are refused until the client has had
        the robot recover (seen by users of a real one: franka_ros, issue 308).
        """
        if not pressed:
            if self.mode == RobotMode.USER_STOPPED:
                self.mode = RobotMode.IDLE
            return b""
        reply = self._finish(MoveStatus.EMERGENCY_ABORTED) if self._move else b""
        self.mode = RobotMode.USER_STOPPED
        self._locked = True
        return reply

    def receive(self, received: bytes) -> tuple[bytes, int | None]:
        """Obey commands from TCP; returns the replies and the client's UDP port once known.

        Raises:
            ValueError: the bytes are not of this protocol
        """
        replies, port = [], None
        for request in self._stream.requests(received):
            if request.command == RobotCommand.CONNECT:
                version, port = struct.unpack("<2H", request.body)
                accepted = version == self._version
                payload = struct.pack("<H", self._version)
                replies.append(self._reply(request, 0 if accepted else 1, payload))
                port = port if accepted else None
            else:
                replies.append(self._obey(request))
        return b"".join(replies), port

    def _reply(self, request: Request, status: int, payload: bytes = b"") -> bytes:
        return self._stream.reply(request.command, request.command_id, status, payload)

    def _obey(self, request: Request) -> bytes:
        if request.command == RobotCommand.MOVE:
            return self._start_motion(request)
        if request.command == RobotCommand.STOP_MOVE:
            ended = self._finish(MoveStatus.PREEMPTED) if self._move else b""
            return self._reply(request, 0) + ended
        if request.command == RobotCommand.AUTOMATIC_ERROR_RECOVERY:
            if self.mode not in (RobotMode.IDLE, RobotMode.REFLEX):
                return self._reply(request, REJECTED)
            self._state["errors"] = False
            self.mode, self._locked = RobotMode.IDLE, False
            return self._reply(request, 0)
        if request.command == RobotCommand.LOAD_MODEL_LIBRARY:
            return self._reply(request, 0, self._model.binary)
        if request.command == RobotCommand.GET_CARTESIAN_LIMIT:
            return self._reply(request, 0, bytes(8 * 22 + 1))
        if self.moving:
            return self._reply(request, REJECTED)
        self._set(request)
        return self._reply(request, 0)

    def _set(self, request: Request) -> None:
        """Take over the settings that change what is emulated; accept the others."""
        if request.command == RobotCommand.SET_COLLISION_BEHAVIOR:
            values = np.frombuffer(request.body, "<f8")
            self._torque_threshold, self._force_threshold = values[21:28], values[46:52]
        elif request.command == RobotCommand.SET_NE_TO_EE:
            NE_T_EE = np.frombuffer(request.body, "<f8")
            F_T_NE = self._state["F_T_NE"].reshape(4, 4).T
            self._state["NE_T_EE"] = NE_T_EE
            self.arm.F_T_EE = (F_T_NE @ NE_T_EE.reshape(4, 4).T).T.ravel()
            self.arm.hold()
        elif request.command == RobotCommand.SET_EE_TO_K:
            self._state["EE_T_K"] = np.frombuffer(request.body, "<f8")

    def _start_motion(self, request: Request) -> bytes:
        controller, generator = struct.unpack_from("<2I", request.body)
        if self.mode != RobotMode.IDLE or self._locked:
            return self._reply(request, MoveStatus.NOT_POSSIBLE)
        if controller > ControllerMode.EXTERNAL or generator + 1 not in tuple(GeneratorMode):
            return self._reply(request, MoveStatus.INVALID_ARGUMENT)
        self.arm.hold()
        self._move, self.started, self._missed_in_a_row = request, False, 0
        self._generator = GeneratorMode(generator + 1)
        self._controller = ControllerMode(controller)
        self.mode = RobotMode.MOVE
        self._state["reflex_reason"] = False
        return self._reply(request, MoveStatus.MOTION_STARTED)

    def _finish(self, status: MoveStatus) -> bytes:
        """End the motion; returns its second reply."""
        assert self._move is not None
        reply = self._reply(self._move, status)
        self.arm.hold()
        self._end_motion()
        return reply

    def _abort(self, name: str) -> bytes:
        self._state["errors"] = self._state["reflex_reason"] = False
        self._state["errors"][ERRORS.index(name)] = True
        self._state["reflex_reason"][ERRORS.index(name)] = True
        reply = self._finish(MoveStatus.REFLEX_ABORTED)
        self.mode = RobotMode.REFLEX
        return reply

    def tick(self, datagram: bytes | None) -> bytes:
        """Let 1 ms of a motion pass; returns what the client is to be told over TCP, if anything.

        Args:
            datagram: the client's command for this tick; None where it is missing
        """
        if self._move is None:
            return b""
        command = None
        if datagram is not None and len(datagram) == ROBOT_COMMAND.itemsize:
            command = np.frombuffer(datagram, ROBOT_COMMAND)[0]
        if command is None:
            return self._miss() if self.started else b""
        self._count(True)
        self._missed_in_a_row = 0
        first, self.started = not self.started, True
        self.ticks += 1
        violation = self.arm.follow(
            command, generator=self._generator, controller=self._controller, first=first
        )
        if violation is None and self._reflex and self.ticks >= self._reflex[1]:
            violation, self._reflex = self._reflex[0], None
        if violation is not None:
            return self._abort(violation)
        if command["motion_generation_finished"]:
            return self._finish(MoveStatus.SUCCESS)
        return b""

    def _miss(self) -> bytes:
        """A command is missing: the arm stands still, and after too many the motion is over."""
        self._count(False)
        self.missed += 1
        self._missed_in_a_row += 1
        if self._missed_in_a_row >= MAX_MISSED:
            return self.lose_communication()
        return b""

    def lose_communication(self) -> bytes:
        """Abort the motion because the client has gone silent; returns the reply."""
        return self._abort("communication_constraints_violation")

    def _count(self, answered: bool) -> None:
        self._answered = [*self._answered[-RATE_WINDOW + 1 :], answered]

    def feel(self, wrench: np.ndarray) -> bytes:
        """Take the contact [N, N m] (6,) of this tick; returns the reply of a collision reflex."""
        self.arm.wrench = wrench
        if self._move is None:
            return b""
        if (np.abs(wrench) > self._force_threshold).any():
            return self._abort("cartesian_reflex")
        if (np.abs(self.arm.tau_ext) > self._torque_threshold).any():
            return self._abort("joint_reflex")
        return b""

    def state(self, message_id: int) -> bytes:
        """Return the state datagram number `message_id`, which is also its time in [ms]."""
        s, arm = self._state, self.arm
        s["message_id"] = message_id
        s["q"] = s["theta"] = arm.q
        s["dq"] = s["dtheta"] = arm.dq
        s["q_d"], s["dq_d"], s["ddq_d"] = arm.q_d, arm.dq_d, arm.ddq_d
        s["tau_J_d"] = s["tau_J"] = arm.tau_d
        s["tau_ext_hat_filtered"] = arm.tau_ext
        s["O_T_EE"] = s["O_T_EE_d"] = arm.O_T_EE
        s["F_T_EE"], s["O_T_EE_c"] = arm.F_T_EE, arm.O_T_EE_c
        s["O_dP_EE_c"], s["O_ddP_EE_c"] = arm.O_dP_EE_c, arm.O_ddP_EE_c
        s["elbow"] = s["elbow_d"] = s["elbow_c"] = (arm.q[2], -1.0)
        s["O_F_ext_hat_K"] = arm.wrench
        s["cartesian_collision"] = np.abs(arm.wrench) > self._force_threshold
        s["motion_generator_mode"], s["controller_mode"] = self._generator, self._controller
        s["robot_mode"] = self.mode
        rate = sum(self._answered) / max(len(self._answered), 1) if self.moving else 0.0
        s["control_command_success_rate"] = rate
        return s.tobytes()
