"""What every robot backend offers, and the errors it raises.

Units are SI and radians; a pose is a 4x4 matrix base_T_tcp. Connecting to a robot and closing the
connection never move the arm. The command methods block until the motion has ended.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np

from warp_deform.errors import WarpDeformError
from warp_deform.support.extras import install_extra

from ..support.closing import Closing
from .panda import GRIPPER_MAX_WIDTH

__all__ = [
    "RECOVER",
    "REFLEX_ADVICE",
    "BackendMissing",
    "ConnectionFailed",
    "ConnectionLost",
    "GraspError",
    "HomesGripper",
    "IncompatibleVersion",
    "JointMoveResult",
    "MotionError",
    "MoveResult",
    "ReflexError",
    "Robot",
    "RobotError",
    "RobotMode",
    "RobotState",
    "SafetyViolation",
    "UnreachablePose",
    "UserStopped",
]


class RobotMode(StrEnum):
    """What the robot is doing, or why it does nothing."""

    IDLE = "idle"
    MOVING = "moving"
    GUIDING = "guiding"
    REFLEX = "reflex"
    USER_STOPPED = "user-stopped"
    RECOVERING = "recovering"
    OTHER = "other"


@dataclass(frozen=True)
class RobotState:
    """A reading of the robot.

    Attributes:
        q: joint positions [rad], shape (7,)
        base_T_tcp: pose of the TCP [m], shape (4, 4)
        force_N: external force [N] and torque [N m] on the TCP in the base frame, shape (6,)
        gripper_width_m: opening between the fingers [m]
        mode: what the robot is doing
    """

    q: np.ndarray
    base_T_tcp: np.ndarray
    force_N: np.ndarray
    gripper_width_m: float
    mode: RobotMode


@dataclass(frozen=True)
class MoveResult:
    """Where a straight motion ended.

    Attributes:
        base_T_tcp: the measured pose [m], shape (4, 4)
        contact: whether the force limit ended it before its target
        slowed_to: greatest speed of the TCP [m/s] where a limit left less than was commanded
    """

    base_T_tcp: np.ndarray
    contact: bool
    slowed_to: float | None = None


@dataclass(frozen=True)
class JointMoveResult:
    """How a motion in joint space was made.

    Attributes:
        speed: share of the joints' greatest speeds
        slowed: whether that is less than was commanded, for the sake of the TCP's speed
    """

    speed: float
    slowed: bool


RECOVER = "recover: press Enter if asked, else start the command again (from Python: recover())"
"""What to do once the cause of a stop is cleared: every command that moves recovers first."""


class RobotError(WarpDeformError):
    """Something went wrong with the robot; the message is one line and ends with what to do.

    Args:
        what: what went wrong
        advice: what to do about it; default: the class's own
    """

    default_advice = f"clear the cause, then {RECOVER}"

    def __init__(self, what: str, *, advice: str | None = None) -> None:
        self.advice = advice or self.default_advice
        super().__init__(f"{' '.join(what.split())}; {self.advice}")


class ConnectionFailed(RobotError):
    """No connection came about."""

    default_advice = (
        "check cable and address, unlock the joints in Desk, activate FCI, and close other clients"
    )


class BackendMissing(ConnectionFailed):
    """The vendor's package is not installed."""

    default_advice = f"install it, in the clone: {install_extra('panda')}"


class IncompatibleVersion(ConnectionFailed):
    """Robot and client speak different versions of the protocol."""

    default_advice = "install the panda-python build for the robot's system version"


class ConnectionLost(RobotError):
    """The robot stopped answering; this connection is of no more use."""

    default_advice = "see whether the arm stands still, check power and network, then connect anew"


class MotionError(RobotError):
    """A motion did not end where it should."""

    default_advice = "see what is in the arm's way; a slower motion or nearer waypoints may help"


class UnreachablePose(MotionError):
    """No joint positions lead there; nothing has moved."""

    default_advice = "choose a pose nearer the middle of the workspace"


class ReflexError(MotionError):
    """The robot stopped itself.

    Attributes:
        reflexes: the robot's names for the reasons
    """

    default_advice = f"look at the arm, clear the cause, then {RECOVER}"

    def __init__(
        self, what: str, *, reflexes: tuple[str, ...] = (), advice: str | None = None
    ) -> None:
        self.reflexes = reflexes
        super().__init__(what, advice=advice or _reflex_advice(reflexes))


def _reflex_advice(reflexes: tuple[str, ...]) -> str | None:
    for part, advice in REFLEX_ADVICE.items():
        if any(part in reflex for reflex in reflexes):
            return advice
    return None


# By a part of the reflex's name; the first that fits counts.
REFLEX_ADVICE = {
    "communication_constraints": (
        f"connect the arm directly, use a real-time kernel, close other programs, then {RECOVER}"
    ),
    "position_limits": f"guide the arm away from its joint limits by hand, then {RECOVER}",
    "velocity": f"{RECOVER}, then move more slowly",
    "discontinuity": f"{RECOVER}, then move more slowly",
    "_reflex": f"the arm touched something: clear it, then {RECOVER}",
}


class UserStopped(MotionError):
    """Somebody pressed the user stop (or it was pressed before)."""

    default_advice = f"make sure the workspace is clear, release the user stop, then {RECOVER}"


class GraspError(RobotError):
    """The gripper did not do as told; a missed grasp is not an error but grasp()'s answer."""

    default_advice = "see that nothing blocks the fingers, then home the gripper"


class SafetyViolation(RobotError):
    """A command was refused before the robot saw it; nothing has moved."""

    default_advice = "change the command; the limits stand in the configuration"


class Robot(Closing, Protocol):
    """An arm with a parallel gripper."""

    def state(self) -> RobotState:
        """Read the robot now; from any thread, also while it moves.

        Raises:
            ConnectionLost: it does not answer
        """
        ...

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Move through joint waypoints to the last one.

        Between two of them the joints move in proportion. The arm comes to rest where the path
        turns by more than 30 degrees; gentler corners may be rounded, by at most 0.02 rad.

        Args:
            q: joint positions [rad], one waypoint (7,) or several (N, 7)
            speed: share of the joints' greatest speeds and accelerations, above 0 and up to 1

        Raises:
            InputError: wrong shape, beyond the joint limits, or a speed that is none
            MotionError: ended elsewhere; ReflexError, UserStopped: the robot stopped
            ConnectionLost: it does not answer
        """
        ...

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Move the TCP to a pose in a straight line, turning evenly on the way.

        Args:
            base_T_tcp: where to [m], shape (4, 4)
            speed: greatest speed of the TCP [m/s]
            stop_force_N: end the motion, without error, when any component of the force on the
                TCP exceeds this [N]

        Raises:
            UnreachablePose: no joint positions lead there, or not without a jump
            InputError, MotionError, ReflexError, UserStopped, ConnectionLost: as move_joints
        """
        ...

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Move the fingers to an opening [m].

        Raises:
            GraspError: they did not get there
            ConnectionLost: the gripper does not answer
        """
        ...

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Close the fingers; returns whether they hold something about `width_m` [m] wide.

        Raises:
            GraspError: the gripper failed (a miss is no failure: it returns False)
            ConnectionLost: the gripper does not answer
        """
        ...

    def stop(self) -> None:
        """End the motion in progress, if any; the gripper keeps what it has. From any thread.

        It holds: every later motion is refused with a `MotionError` until `recover`.
        """
        ...

    def recover(self) -> None:
        """Have the robot recover from what stopped it, so that it accepts motions; moves nothing.

        Needed after a reflex, after `stop`, and after a user stop, also where the state does not
        show that any more; harmless otherwise. A `stop` that comes meanwhile holds.

        Raises:
            UserStopped: the user stop is pressed
            ReflexError: the robot needs to be recovered by hand
            ConnectionLost: it does not answer
        """
        ...

    def close(self) -> None:
        """End the connection; moves nothing, and may be called twice."""
        ...


@runtime_checkable
class HomesGripper(Protocol):
    """A backend whose fingers can find their zero; not every vendor's interface offers that."""

    def home_gripper(self) -> None:
        """Close and open the fingers to find their zero; needed once after the hand was powered.

        Raises:
            GraspError: they did not get through
            ConnectionLost: the gripper does not answer
        """
        ...
