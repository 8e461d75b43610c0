"""What every backend of a Franka arm expects of it."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["RECOVERY_TIMEOUT", "FrankaConfig", "NetworkedConfig"]

RECOVERY_TIMEOUT = 30.0
"""Longest wait for a recovery [s]; users measured 0.2 to 16 s (franka_ros, issues 308 and 317)."""


@dataclass(frozen=True, kw_only=True)
class FrankaConfig:
    """When a motion has arrived, and when the fingers hold something."""

    collision_force_N: float = 20.0
    """Force [N], and torque [N m], on the hand that makes the robot stop itself."""
    arrival_tolerance_m: float = 3e-3
    """How far from its target the TCP may end [m]."""
    arrival_tolerance_rad: float = 0.035
    """How far from its target orientation the TCP may end [rad], 2 degrees."""
    gripper_speed: float = 0.05
    """Speed of the opening [m/s]."""
    min_held_m: float = 5e-4
    """Opening after a grasp at and below which the fingers hold nothing [m]."""
    held_tolerance_m: float = 5e-3
    """How much wider than expected a held object may be [m]."""


@dataclass(frozen=True, kw_only=True)
class NetworkedConfig(FrankaConfig):
    """The same of a robot whose control box is spoken to directly."""

    host: str = "172.16.0.2"
    """Address of the robot's control box; the vendor's default."""
    collision_torque_Nm: float = 20.0
    """Torque at any joint that makes the robot stop itself [N m]; the vendor's default."""
    connect_timeout_s: float = 10.0
    """Time for the connection and the model library [s]."""
