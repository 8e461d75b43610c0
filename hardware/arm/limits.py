"""The limits that a command has to keep, and how far a pose or a path is beyond them.

All of them are convex in the position of a point of the hand, so a straight segment between two
points within them is within them. Between the samples of a path in joint space a point of the hand
leaves its chord by at most (sum of the joints' turns)^2 * radius / 8; the samples lie so dense that
this is below `PATH_TOLERANCE`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_deform.errors import InputError

from .arguments import real_number, shown
from .panda import Q_MAX, Q_MIN
from .table_plane import TablePlane

__all__ = [
    "FINGERTIP_BELOW_TCP",
    "HAND_POINTS",
    "LIMIT_NAMES",
    "PATH_TOLERANCE",
    "SafetyLimits",
    "dense_path",
]

PATH_TOLERANCE = 1e-4
"""How far beyond a limit a path in joint space may come between its waypoints [m], [rad]."""
# Below the sum over the joints of their turns between two samples [rad]: with a hand within 1.4 m
# of every axis it leaves the chord by at most 0.07 mm.
_SAMPLE_TURN = 0.02
FINGERTIP_BELOW_TCP = 0.009
"""How far the vendor's fingertips reach below the TCP [m]; measure others."""
_FOAM_GIVES = 0.003  # [m] that a tilted fingertip may press into the foam
HAND_POINTS = np.array(
    [[x, y, FINGERTIP_BELOW_TCP, 1.0] for x in (-0.01, 0.01) for y in (-0.05, 0.05)]
    + [[x, y, -0.045, 1.0] for x in (-0.032, 0.032) for y in (-0.102, 0.102)]
)
HAND_POINTS.flags.writeable = False
"""Corners of the open fingers' tips and of the hand's lower face in the TCP frame [m], (8, 4)."""
LIMIT_NAMES = (
    "workspace x, low side",
    "workspace x, high side",
    "workspace y, low side",
    "workspace y, high side",
    "ceiling",
    "floor (table + min_tcp_height_m)",
    "hand above the table",
    "tilt of the hand",
)
"""What the columns of `SafetyLimits.excess` stand for; all in m but the tilt, in rad."""


@dataclass(frozen=True, kw_only=True)
class SafetyLimits:
    """What `SafeRobot` lets through. Lengths [m] in the base frame."""

    table: TablePlane
    """The measured table; there is no default, because a guessed floor is none."""
    x: tuple[float, float] = (0.335, 0.635)
    """Workspace along x: 30 cm of foam. Nearer the base, joint 4 would come too near its limit when
    the hand is down at the table; on the first centimetre straight ahead it does already."""
    y: tuple[float, float] = (-0.30, 0.30)
    """Workspace along y: 60 cm of foam."""
    margin_m: float = 0.03
    """How far the TCP may leave the workspace sideways."""
    max_z_m: float = 0.60
    """Highest TCP."""
    min_tcp_height_m: float = 0.009
    """Lowest TCP above the table: the vendor's fingertips reach 9 mm below the TCP."""
    max_tilt_rad: float = 0.52
    """How far the hand may lean from straight down: calibration needs 25 degrees."""
    max_joint_speed: float = 0.05
    """Share of the joints' greatest speeds in joint space; a first run's value. At most 0.2."""
    max_speed: float = 0.10
    """Speed of the TCP [m/s]. At most 0.25, the reduced speed of ISO 10218-1."""
    max_descent_speed: float = 0.05
    """Speed of the TCP downwards, and of a straight line that ends lower than it begins [m/s]. At
    most 0.05."""
    contact_height_m: float = 0.05
    """Below this height above the table nothing goes down but a straight line that stops on
    contact."""
    max_contact_force_N: float = 8.0
    """Greatest force at which a descent stops [N]."""
    max_grasp_force_N: float = 20.0
    """Greatest force of the fingers [N]: a bead chain needs 10 and is crushed by the hand's 70."""
    joint_margin: float = 0.05
    """Share of each joint's range that waypoints keep from either end."""
    max_joint_step_rad: float = 0.5
    """Greatest change of a joint from one waypoint to the next: more is a flip of the arm."""
    arrival_tolerance_m: float = 3e-3
    """How far from its target a motion may end."""
    arrival_tolerance_rad: float = 0.035
    """How far from its target orientation a motion may end, 2 degrees."""
    max_recoveries: int = 2
    """Recoveries from a reflex in one episode without an operator."""

    def __post_init__(self) -> None:
        ranges = {
            "margin_m": (0.0, 0.2),
            "max_z_m": (0.05, 1.2),
            "min_tcp_height_m": (0.0, 0.2),
            "max_tilt_rad": (0.0, 1.0),
            "max_joint_speed": (1e-3, 0.2),
            "max_speed": (1e-3, 0.25),
            "max_descent_speed": (1e-3, 0.05),
            "contact_height_m": (0.0, 0.3),
            "max_contact_force_N": (0.5, 20.0),
            "max_grasp_force_N": (0.5, 70.0),
            "joint_margin": (0.0, 0.4),
            "max_joint_step_rad": (0.01, 0.5),
            "arrival_tolerance_m": (1e-4, 5e-3),
            "arrival_tolerance_rad": (1e-3, 0.05),
            "max_recoveries": (0, 10),
        }
        for name, (low, high) in ranges.items():
            value = real_number(f"safety limit {name}", getattr(self, name))
            if not low <= value <= high:  # also when it is not a number
                raise InputError(f"safety limit {name} is {value}; allowed: {low} to {high}")
        for name in ("x", "y"):
            object.__setattr__(self, name, _interval(name, getattr(self, name)))
        if not isinstance(self.table, TablePlane):
            raise InputError(f"safety limit table: a TablePlane is needed, not {shown(self.table)}")

    @property
    def q_min(self) -> np.ndarray:
        """Lowest joint positions of a waypoint [rad], shape (7,)."""
        return Q_MIN + self.joint_margin * (Q_MAX - Q_MIN)

    @property
    def q_max(self) -> np.ndarray:
        """Highest joint positions of a waypoint [rad], shape (7,)."""
        return Q_MAX - self.joint_margin * (Q_MAX - Q_MIN)

    def height(self, base_T_tcp: np.ndarray) -> np.ndarray:
        """Return how high above the table the TCP of poses (..., 4, 4) is [m], shape (...)."""
        height: np.ndarray = base_T_tcp[..., 2, 3] - self.table.z(base_T_tcp[..., :2, 3])
        return height

    def excess(self, base_T_tcp: np.ndarray) -> np.ndarray:
        """Return how far poses (N, 4, 4) are beyond each of `LIMIT_NAMES`, (N, 8); within: <= 0."""
        tcp = base_T_tcp[:, :3, 3]
        points = np.einsum("nij,kj->nki", base_T_tcp[:, :3], HAND_POINTS)
        clearance = points[..., 2] - self.table.z(points[..., :2])
        lowest = self.min_tcp_height_m - FINGERTIP_BELOW_TCP - _FOAM_GIVES
        tilt = np.arctan2(np.hypot(base_T_tcp[:, 0, 2], base_T_tcp[:, 1, 2]), -base_T_tcp[:, 2, 2])
        return np.stack(
            [
                self.x[0] - self.margin_m - tcp[:, 0],
                tcp[:, 0] - self.x[1] - self.margin_m,
                self.y[0] - self.margin_m - tcp[:, 1],
                tcp[:, 1] - self.y[1] - self.margin_m,
                tcp[:, 2] - self.max_z_m,
                self.min_tcp_height_m - self.height(base_T_tcp),
                lowest - clearance.min(axis=1),
                tilt - self.max_tilt_rad,
            ],
            axis=1,
        )


def _interval(name: str, value: object) -> tuple[float, float]:
    """Return two numbers in their order, as a tuple that nobody can write into."""
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != 2:
        raise InputError(f"safety limit {name} is {shown(value)}; give (low, high) [m]")
    low, high = (real_number(f"safety limit {name}", end) for end in value)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"safety limit {name} is ({low}, {high}); give (low, high) [m]")
    return low, high


def dense_path(points: np.ndarray) -> np.ndarray:
    """Return joint positions along the path through `points` (N, 7) [rad], (M, 7), M >= N.

    They hold every point, and lie so dense that checking them checks the path (see the module).
    """
    steps = np.diff(points, axis=0)
    counts = np.maximum(np.ceil(np.abs(steps).sum(axis=1) / _SAMPLE_TURN).astype(int), 1)
    owner = np.repeat(np.arange(len(steps)), counts)
    # The number of each sample within its step, from 1.
    number = np.arange(1, len(owner) + 1) - np.repeat(np.cumsum(counts) - counts, counts)
    shares = (number / counts[owner])[:, None]
    # Exactly the waypoints at their ends, without rounding.
    between = np.where(shares == 1.0, points[owner + 1], points[owner] + shares * steps[owner])
    return np.vstack([points[:1], between])
