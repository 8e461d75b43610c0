"""How far the hand has sunk without a stop force: an arm that sags creeps into the table otherwise.

A motion without a stop force may end a little lower than it began, because an arm that has arrived
a little high goes on to where it was to be. Many such motions would add up to a descent that stops
on nothing. So below `contact_height_m` their sinkings are added up, until the hand has risen again.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from .limits import SafetyLimits
from .robot import Robot, RobotError

__all__ = ["LEVEL", "Sinking", "sunk_after"]

LEVEL = 1e-3
"""What a hand may sink in all without a stop force [m]."""


def sunk_after(
    limits: SafetyLimits, start: np.ndarray, end: np.ndarray, *, sunk: float, stops: bool
) -> float:
    """Return how far the hand has sunk without a stop force after a motion [m].

    Heights above `contact_height_m` count as that; rising takes back what it has sunk.

    Args:
        limits: where the table is, and the height below which sinking counts
        start: pose before the motion [m], (4, 4)
        end: pose after it [m], (4, 4)
        sunk: before it [m]
        stops: whether it stops on contact
    """
    low = limits.contact_height_m
    drop = min(float(limits.height(start)), low) - min(float(limits.height(end)), low)
    return max(sunk + (min(drop, 0.0) if stops else drop), 0.0)


class Sinking:
    """How far a robot's hand has sunk, motion by motion.

    Args:
        limits: where the table is, and the height below which sinking counts

    Attributes:
        sunk_m: without a stop force, since the hand has last risen [m]
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self._limits = limits
        self.sunk_m = 0.0

    @contextmanager
    def measured(self, robot: Robot, start: np.ndarray, *, stops: bool) -> Iterator[None]:
        """Enclose a motion; where the hand is afterwards counts, whether or not it went well.

        Args:
            robot: is read after the motion
            start: pose before it [m], (4, 4)
            stops: whether it stops on contact
        """
        # Until it is read where the motion has ended, the hand may have sunk.
        sunk, self.sunk_m = self.sunk_m, max(self.sunk_m, LEVEL)
        try:
            yield
        finally:
            self._read(robot, start, sunk=sunk, stops=stops)

    def _read(self, robot: Robot, start: np.ndarray, *, sunk: float, stops: bool) -> None:
        try:
            end = robot.state().base_T_tcp
        except RobotError:
            return  # the motion's own error says more; nothing sinks further without a stop force
        self.sunk_m = sunk_after(self._limits, start, end, sunk=sunk, stops=stops)
