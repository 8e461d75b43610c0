"""Measuring the table by touching it with the closed gripper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_deform.errors import InputError

from ..arm.limits import FINGERTIP_BELOW_TCP
from ..arm.robot import GraspError, MotionError
from ..arm.safe_robot import SafeRobot

__all__ = ["TouchOffConfig", "close_fingers", "touch_off"]

_CLOSED = 2e-3  # [m]
# A table is not met so soon: what ends a descent there is the arm's own jerk, or an obstacle [m].
_MIN_DESCENT = 5e-3
# Share of the stop force that the hand may feel in the air: the robot does not tare.
_MAX_FELT = 0.5


@dataclass(frozen=True, kw_only=True)
class TouchOffConfig:
    """How gently."""

    force_N: float = 3.0
    """Force at which the table counts as touched [N]."""
    speed: float = 0.01
    """Speed of the descent [m/s]: the arm goes on for some milliseconds after the contact."""
    hover_m: float = 0.06
    """Height above the provisional table from which each descent starts [m]."""


def touch_off(
    robot: SafeRobot, points_xy: Sequence[tuple[float, float]], config: TouchOffConfig | None = None
) -> np.ndarray:
    """Touch the table at each x, y [m] and return the touched points (n, 3) [m].

    The robot's limits carry a provisional table, some 2 cm lower than the real one may be: its
    floor ends a descent that touches nothing. Fit the points with `fit_table_plane` and build the
    limits anew. Afterwards the hand is above the last point, the fingers are closed.

    Raises:
        InputError: a descent touched nothing
        MotionError: something was met above a point or within 5 mm of a descent's start, or the
            hand feels more than half of `force_N` in the air
        RobotError: see `SafeRobot`; SafetyViolation before anything moved
    """
    config = config or TouchOffConfig()
    limits = robot.limits
    lines: list[tuple[np.ndarray, float, float | None]] = []
    for xy in points_xy:
        above, below = _down(xy), _down(xy)
        table = float(limits.table.z(np.array(xy)))
        above[2, 3] = table + config.hover_m
        below[2, 3] = table + limits.min_tcp_height_m + 1e-3
        lines += [
            (above, limits.max_descent_speed, limits.max_contact_force_N),
            (below, config.speed, config.force_N),
            (above, limits.max_speed, None),
        ]
    robot.check_lines(lines)
    close_fingers(robot)
    touched = []
    for number, (start, end, back) in enumerate(
        zip(lines[0::3], lines[1::3], lines[2::3], strict=True), start=1
    ):
        if robot.move_linear(start[0], speed=start[1], stop_force_N=start[2]).contact:
            raise MotionError(f"the hand met something on its way above point {number}")
        before = robot.state()
        felt = float(np.linalg.norm(before.force_N[:3]))
        if felt > _MAX_FELT * config.force_N:
            raise MotionError(
                f"above point {number} the hand feels {felt:.1f} N in the air, "
                f"{_MAX_FELT * config.force_N:g} N are allowed",
                advice="set the hand's mass in Desk, take off what hangs on it, and begin again",
            )
        result = robot.move_linear(end[0], speed=end[1], stop_force_N=end[2])
        robot.move_linear(back[0], speed=back[1])
        went = float(before.base_T_tcp[2, 3] - result.base_T_tcp[2, 3])
        if result.contact and went < _MIN_DESCENT:
            raise MotionError(
                f"the hand met something {1e3 * went:.1f} mm below where its descent to point "
                f"{number} began, which is no table",
                advice="see what is there; a --table-z that is too high also does this",
            )
        if not result.contact:
            raise InputError(
                f"touching point {number}: nothing met down to {end[0][2, 3]:.3f} m; lower the "
                "provisional table"
            )
        tip = result.base_T_tcp[:3, 3] - (0.0, 0.0, FINGERTIP_BELOW_TCP)
        touched.append(tip)
    return np.array(touched).reshape(-1, 3)


def close_fingers(robot: SafeRobot) -> None:
    """Close the fingers, with nothing between them: their tips are then the point that touches.

    Raises:
        GraspError: they are not closed
    """
    robot.grasp(width_m=1e-3, force_N=min(10.0, robot.limits.max_grasp_force_N))
    if robot.state().gripper_width_m > _CLOSED:
        raise GraspError("the fingers are not closed; take out what is between them")


def _down(xy: tuple[float, float]) -> np.ndarray:
    """Return a pose above x, y whose hand points straight down, at height 0."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:2, 3] = xy
    return T
