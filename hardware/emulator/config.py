"""Where the emulator listens, how its time runs and how the arm stands at first."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from warp_deform.errors import InputError

from ..panda_arm import GRIPPER_MAX_WIDTH, HOME_Q
from .protocol import ROBOT_VERSION

__all__ = ["EmulatorConfig"]


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
        if not _is_loopback(self.host):
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


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return False
