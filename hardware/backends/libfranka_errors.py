"""From what libfranka says to what it means: its messages as typed errors."""

from __future__ import annotations

import re

from ..arm.robot import ConnectionLost, MotionError, ReflexError, RobotError, UserStopped

__all__ = ["reflex_names", "typed_error"]

GONE = ("UDP", "TCP", "server closed", "onnection reset", "roken pipe")


def typed_error(message: str, *, host: str) -> RobotError:
    """Return the error that a message of libfranka 0.9 from the robot at `host` stands for."""
    if "user stop" in message.lower():
        return UserStopped(message)
    if "reflex" in message.lower():
        return ReflexError(message, reflexes=reflex_names(message))
    if "Move" in message and "not possible in the current mode" in message:
        # A robot whose user stop was pressed and released says so; its state looks like any other.
        return UserStopped(message)
    if any(word in message for word in GONE):
        return ConnectionLost(f"{host}: {message}")
    return MotionError(message)


def reflex_names(message: str) -> tuple[str, ...]:
    """Return the names in a message such as `reflex! ["joint_reflex", "cartesian_reflex"]`."""
    return tuple(re.findall(r'"([^"]+)"', message))
