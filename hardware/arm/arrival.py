"""Where a motion ended: at its target, or short of it against something."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .robot import MotionError, MoveResult, RobotMode, RobotState
from .straight_line import distance

__all__ = [
    "ArrivalTolerance",
    "check_arrival",
    "check_joints_arrival",
    "has_arrived",
    "pressed_contact",
]

# How far a soft arm that presses may slide from its line [m].
_SLIDE = 6e-3
# Share of the stop force against the motion that tells a contact from a failed motion.
_PRESSING = 0.25


class ArrivalTolerance(Protocol):
    """What says how far from its target a motion may end: `SafetyLimits`, a backend's config."""

    @property
    def arrival_tolerance_m(self) -> float:
        """Of the TCP's position [m]."""
        ...

    @property
    def arrival_tolerance_rad(self) -> float:
        """Of its orientation, or of a joint [rad]."""
        ...


def has_arrived(tolerance: ArrivalTolerance, reached: np.ndarray, target: np.ndarray) -> bool:
    """Return whether a measured pose (4, 4) [m] is as near its target as an arrival has to be."""
    off, turned = distance(reached, target)
    return off <= tolerance.arrival_tolerance_m and turned <= tolerance.arrival_tolerance_rad


def check_arrival(tolerance: ArrivalTolerance, reached: np.ndarray, target: np.ndarray) -> None:
    """Refuse a measured pose (4, 4) [m] that is not at its target.

    Raises:
        MotionError: it is farther off than an arrival may be
    """
    if not has_arrived(tolerance, reached, target):
        off, turned = distance(reached, target)
        raise MotionError(
            f"the TCP ended {1e3 * off:.1f} mm and {turned:.3f} rad from its target "
            f"(allowed: {1e3 * tolerance.arrival_tolerance_m:.1f} mm, "
            f"{tolerance.arrival_tolerance_rad:.3f} rad)"
        )


def check_joints_arrival(
    tolerance: ArrivalTolerance, reached: np.ndarray, target: np.ndarray
) -> None:
    """Refuse measured joint positions (7,) [rad] that are not at their target.

    Raises:
        MotionError: a joint is farther off than an arrival may be
    """
    off = float(np.abs(reached - target).max())
    if not off <= tolerance.arrival_tolerance_rad:  # also when it is not a number
        raise MotionError(f"a joint ended {off:.3f} rad from its target")


def pressed_contact(
    state: RobotState, start: np.ndarray, target: np.ndarray, stop_force_N: float
) -> MoveResult | None:
    """Return a contact where the hand ended short of its target, on its line, pressing; else None.

    The arm's controller is soft: a surface a few millimetres above the target holds it with less
    than the stop force. That is the contact that was looked for.

    Args:
        state: after the motion
        start: pose at the start of the line [m], (4, 4)
        target: pose at its end [m], (4, 4)
        stop_force_N: at which it was to stop
    """
    line = target[:3, 3] - start[:3, 3]
    length = max(float(np.linalg.norm(line)), 1e-9)
    advance = float((state.base_T_tcp[:3, 3] - start[:3, 3]) @ line) / length
    aside = np.linalg.norm(state.base_T_tcp[:3, 3] - start[:3, 3] - advance * line / length)
    force = -float(state.force_N[:3] @ line) / length
    on_line = 0.0 <= advance <= length and aside <= _SLIDE
    if state.mode != RobotMode.IDLE or not on_line or force < _PRESSING * stop_force_N:
        return None
    return MoveResult(state.base_T_tcp, contact=True)
