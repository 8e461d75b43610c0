"""Whether the hand, pointing down, gets to every part of a workspace, and may wait at its home."""

from __future__ import annotations

import functools
import math

import numpy as np

from warp_deform.errors import InputError

from ..arm.limits import LIMIT_NAMES, SafetyLimits
from ..arm.panda import PandaKinematics
from ..arm.pick_place import PickPlaceConfig, hand_down
from ..arm.robot import UnreachablePose
from ..arm.straight_line import straight_line
from ..arm.table_plane import TablePlane
from .workplace import Workplace

__all__ = ["check_workplace", "unreached"]

_ROWS, _COLUMNS = 17, 9
_MOST_UNREACHED = 0.1
"""Share of a workspace that may be out of reach: the paper's own has 3 % near the base."""


def check_workplace(workplace: Workplace, limits: SafetyLimits) -> str | None:
    """Refuse a home pose beyond the limits or a workspace out of reach.

    Returns:
        a line about a small part that is out of reach; None where all is reached

    Raises:
        InputError: which of the two, by how much, and what to change
    """
    home = PandaKinematics().pose(np.array(workplace.home_q))
    excess = limits.excess(home[None])[0]
    worst = int(np.argmax(excess))
    x, y, z = home[:3, 3]
    where = f"--home puts the TCP at ({x:.3f}, {y:.3f}, {z:.3f}) m"
    if excess[worst] > 0.0:
        unit = "rad" if worst == len(LIMIT_NAMES) - 1 else "m"
        raise InputError(f"{where}, beyond {LIMIT_NAMES[worst]} by {excess[worst]:.3f} {unit}")
    low = limits.q_min > np.array(workplace.home_q)
    high = limits.q_max < np.array(workplace.home_q)
    if (low | high).any():
        joint = int(np.argmax(low | high))
        raise InputError(
            f"--home: joint {joint + 1} at {workplace.home_q[joint]:.3f} rad; allowed: "
            f"{limits.q_min[joint]:.3f} to {limits.q_max[joint]:.3f}"
        )
    height = float(limits.height(home))
    if height < limits.contact_height_m:
        raise InputError(
            f"{where}, {height:.3f} m above the table; {limits.contact_height_m:g} m are needed"
        )
    points = unreached(workplace, limits.table, limits.joint_margin)
    if not points:
        return None
    share = len(points) / (_ROWS * _COLUMNS)
    ends = np.array(points)
    (x0, y0), (x1, y1) = ends.min(axis=0), ends.max(axis=0)
    part = (
        f"the hand does not get down to {100 * share:.0f} % of the workspace, within x {x0:.3f} to "
        f"{x1:.3f}, y {y0:.3f} to {y1:.3f} m"
    )
    if share > _MOST_UNREACHED:
        raise InputError(f"{workplace.workspace_text()}: {part}; move or shrink it")
    return f"{part}: actions there are refused, and others proposed"


@functools.lru_cache(maxsize=8)
def unreached(
    workplace: Workplace, table: TablePlane, joint_margin: float
) -> tuple[tuple[float, float], ...]:
    """Return the points x, y [m] of a grid over the workspace where the hand cannot take a cable.

    The hand points down at the height of a grasp and lies along the arm's direction, which leaves
    its last joint in the middle; how far a tangent turns it from there is checked with each action.
    """
    arm, limits = PandaKinematics(), workplace.limits(table, joint_margin=joint_margin)

    def joints_at(x: float, y: float, start: np.ndarray) -> np.ndarray:
        target = hand_down((x, y), PickPlaceConfig().grasp_m, math.atan2(y, x), table)
        return straight_line(arm, start, target, speed=0.1).q[-1]

    xs, ys = np.linspace(*workplace.x, _COLUMNS), np.linspace(*workplace.y, _ROWS)
    q = np.array(workplace.home_q)
    try:  # begun in the middle, and gone on from point to neighbouring point
        q = joints_at(xs[_COLUMNS // 2], ys[_ROWS // 2], q)
    except UnreachablePose:
        return tuple((float(x), float(y)) for y in ys for x in xs)
    missed = []
    middle = _ROWS // 2
    for rows in (ys[middle:], ys[:middle][::-1]):
        neighbour = q
        for index, y in enumerate(rows):
            for x in xs if index % 2 else xs[::-1]:
                try:
                    neighbour = joints_at(x, y, neighbour)
                except UnreachablePose:
                    missed.append((float(x), float(y)))
                    continue
                if (neighbour < limits.q_min).any() or (neighbour > limits.q_max).any():
                    missed.append((float(x), float(y)))
    return tuple(missed)
