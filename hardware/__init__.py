"""The cable task on a Franka arm: robots behind one protocol, and an emulated one to rehearse on.

The backends stand in `hardware.backends`, the emulator in `hardware.emulator`. The package depends
on `warp_deform` and never the other way round; importing it loads no vendor's library and opens no
device.
"""

from .arm.robot import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    GraspError,
    IncompatibleVersion,
    MotionError,
    MoveResult,
    ReflexError,
    Robot,
    RobotError,
    RobotMode,
    RobotState,
    SafetyViolation,
    UnreachablePose,
    UserStopped,
)

__all__ = [
    "BackendMissing",
    "ConnectionFailed",
    "ConnectionLost",
    "GraspError",
    "IncompatibleVersion",
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
