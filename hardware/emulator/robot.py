"""The robot's side of the interface: what a state says, what a command does, and how motions end.

No sockets here: requests in, answers out, one call a tick. `server.py` decides when a tick is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from warp_deform.errors import InputError

from .arm import ELBOW_SIGN, Arm
from .model_library import ModelLibrary
from .protocol import (
    ERRORS,
    ROBOT_COMMAND,
    ROBOT_STATE,
    ControllerMode,
    GeneratorMode,
    MoveStatus,
    Request,
    RobotCommand,
    RobotMode,
    SetStatus,
)
from .requests import ROBOT_FORMS, read

__all__ = ["Answer", "EmulatedRobot"]

# Commands that may be missing in a row before the motion is aborted, as on the robot.
MAX_MISSED = 20
# Commands over which the success rate is counted.
RATE_WINDOW = 100
# How much contact is too much until the client says otherwise [N m], [N, N m].
DEFAULT_TORQUE_THRESHOLD, DEFAULT_FORCE_THRESHOLD = 20.0, 20.0
IDENTITY = np.eye(4).ravel()
# What GetCartesianLimit says where there is no wall: its size, frame, and whether it is active.
NO_WALL = bytes(8 * (3 + 16) + 1)


class Answer(NamedTuple):
    """A reply: to which request, how it ended, and what follows."""

    request: Request
    status: int
    payload: bytes = b""


class EmulatedRobot:
    """An arm behind the Franka Control Interface.

    Attributes:
        arm: the joints
        mode: what the robot is doing
        ticks: commands obeyed since the start
        missed: commands missing since the start
    """

    def __init__(self, model: ModelLibrary, *, q: np.ndarray) -> None:
        self.arm = Arm(model, q=q)
        self.mode = RobotMode.IDLE
        self.ticks = self.missed = 0
        self._model = model
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

    def schedule_reflex(self, name: str, *, after_ticks: int) -> None:
        """Abort by reflex `name` when `after_ticks` more commands have been obeyed."""
        if name not in ERRORS:
            raise InputError(f"reflex: one of {', '.join(ERRORS)}, not {name!r}")
        self._reflex = (name, self.ticks + after_ticks)

    def user_stop(self, pressed: bool) -> Answer | None:
        """Press or release the user stop; returns what the client is told over TCP.

        Released, the state looks like any other, but motions are refused until the client has had
        the robot recover (seen by users of a real one: franka_ros, issue 308).
        """
        if not pressed:
            if self.mode == RobotMode.USER_STOPPED:
                self.mode = RobotMode.IDLE
            return None
        answer = self._finish(MoveStatus.EMERGENCY_ABORTED) if self._move else None
        self.mode = RobotMode.USER_STOPPED
        self._locked = True
        return answer

    def obey(self, request: Request) -> list[Answer]:
        """Obey a command from TCP, or refuse it without harm; returns what the client is told.

        Raises:
            ValueError: there is no such command
        """
        values = read(request, ROBOT_FORMS)
        if values is None:
            return [Answer(request, ROBOT_FORMS[request.command].refusal)]
        if request.command == RobotCommand.MOVE:
            return [self._start_motion(request, values)]
        if request.command == RobotCommand.STOP_MOVE:
            ended = [self._finish(MoveStatus.PREEMPTED)] if self._move else []
            return [Answer(request, SetStatus.SUCCESS), *ended]
        if request.command == RobotCommand.AUTOMATIC_ERROR_RECOVERY:
            if self.mode not in (RobotMode.IDLE, RobotMode.REFLEX):
                return [Answer(request, SetStatus.NOT_POSSIBLE)]
            self._state["errors"] = False
            self.mode, self._locked = RobotMode.IDLE, False
        elif request.command == RobotCommand.LOAD_MODEL_LIBRARY:
            return [Answer(request, SetStatus.SUCCESS, self._model.binary)]
        elif request.command == RobotCommand.GET_CARTESIAN_LIMIT:
            return [Answer(request, SetStatus.SUCCESS, NO_WALL)]
        elif self.moving:
            return [Answer(request, SetStatus.NOT_POSSIBLE)]
        else:
            self._set(request.command, np.array(values, dtype=np.float64))
        return [Answer(request, SetStatus.SUCCESS)]

    def _set(self, command: int, values: np.ndarray) -> None:
        """Take over the settings that change what is emulated; accept the others."""
        if command == RobotCommand.SET_COLLISION_BEHAVIOR:
            self._torque_threshold, self._force_threshold = values[21:28], values[46:52]
        elif command == RobotCommand.SET_NE_TO_EE:
            F_T_NE = self._state["F_T_NE"].reshape(4, 4).T
            self._state["NE_T_EE"] = values
            self.arm.F_T_EE = (F_T_NE @ values.reshape(4, 4).T).T.ravel()
            self.arm.hold()
        elif command == RobotCommand.SET_EE_TO_K:
            self._state["EE_T_K"] = values
        elif command == RobotCommand.SET_LOAD:
            self._state["m_load"], self._state["F_x_Cload"] = values[0], values[1:4]
            self._state["I_load"] = values[4:]

    def _start_motion(self, request: Request, values: tuple[Any, ...]) -> Answer:
        if self.mode != RobotMode.IDLE or self._locked:
            return Answer(request, MoveStatus.NOT_POSSIBLE)
        self.arm.hold()
        self._move, self.started, self._missed_in_a_row = request, False, 0
        self._answered = []
        self._controller = ControllerMode(values[0])
        self._generator = GeneratorMode(values[1] + 1)
        self.mode = RobotMode.MOVE
        self._state["reflex_reason"] = False
        return Answer(request, MoveStatus.MOTION_STARTED)

    def _finish(self, status: MoveStatus) -> Answer:
        """End the motion; returns its second reply."""
        assert self._move is not None
        answer = Answer(self._move, status)
        self.arm.hold()
        self._end_motion()
        return answer

    def _abort(self, *names: str) -> Answer:
        flags = [ERRORS.index(name) for name in names]
        for reasons in (self._state["errors"], self._state["reflex_reason"]):
            reasons[:] = False
            reasons[flags] = True
        answer = self._finish(MoveStatus.REFLEX_ABORTED)
        self.mode = RobotMode.REFLEX
        return answer

    def tick(self, datagram: bytes | None) -> Answer | None:
        """Let 1 ms of a motion pass; returns what the client is to be told over TCP, if anything.

        Args:
            datagram: the client's command for this tick, as many bytes as one has; None where it
                is missing
        """
        if self._move is None:
            return None
        if datagram is None:
            return self._miss() if self.started else None
        command = np.frombuffer(datagram, ROBOT_COMMAND)[0]
        self._count(True)
        self._missed_in_a_row = 0
        first, self.started = not self.started, True
        self.ticks += 1
        names = self.arm.follow(
            command, generator=self._generator, controller=self._controller, first=first
        )
        if not names and self._reflex and self.ticks >= self._reflex[1]:
            names, self._reflex = (self._reflex[0],), None
        if names:
            return self._abort(*names)
        if command["motion_generation_finished"]:
            return self._finish(MoveStatus.SUCCESS)
        return None

    def _miss(self) -> Answer | None:
        """A command is missing: the motion goes on, and after too many of them it is over."""
        self._count(False)
        self.missed += 1
        self._missed_in_a_row += 1
        if self._missed_in_a_row >= MAX_MISSED:
            return self.lose_communication()
        names = self.arm.go_on(generator=self._generator, controller=self._controller)
        return self._abort(*names) if names else None

    def lose_communication(self) -> Answer:
        """Abort the motion because the client has gone silent; returns the answer."""
        return self._abort("communication_constraints_violation")

    def _count(self, answered: bool) -> None:
        self._answered = [*self._answered[-RATE_WINDOW + 1 :], answered]

    def feel(self, wrench: np.ndarray) -> Answer | None:
        """Take the contact [N, N m] (6,) of this tick; returns the answer of a collision reflex."""
        self.arm.wrench = wrench
        if self._move is None:
            return None
        if (np.abs(wrench) > self._force_threshold).any():
            return self._abort("cartesian_reflex")
        if (np.abs(self.arm.tau_ext) > self._torque_threshold).any():
            return self._abort("joint_reflex")
        return None

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
        s["elbow"] = s["elbow_d"] = (arm.q[2], ELBOW_SIGN)
        s["elbow_c"] = (arm.elbow, ELBOW_SIGN)
        s["delbow_c"][0], s["ddelbow_c"][0] = arm.delbow, arm.ddelbow
        s["O_F_ext_hat_K"] = arm.wrench
        s["cartesian_collision"] = np.abs(arm.wrench) > self._force_threshold
        s["motion_generator_mode"], s["controller_mode"] = self._generator, self._controller
        s["robot_mode"] = self.mode
        rate = sum(self._answered) / max(len(self._answered), 1) if self.moving else 0.0
        s["control_command_success_rate"] = rate
        return s.tobytes()
