"""How the arm moves during one action: what films and the page in the browser show of it."""

from __future__ import annotations

import numpy as np

from .episode import StepReport

__all__ = ["ArmPath"]


class ArmPath:
    """Joint positions during one action: along its motions, from where the last one ended.

    Args:
        waiting: joint positions (dof,) [rad] before the action

    Attributes:
        seconds: how long the motions take [s]
    """

    def __init__(self, report: StepReport, waiting: np.ndarray) -> None:
        times, joints = [np.zeros(1)], [waiting[None]]
        begin = 0.0
        for motion, q in zip(report.motions, report.joints, strict=True):
            if q is None:  # out of reach: the arm stays where it is
                break
            times.append(begin + motion.times)
            joints.append(q)
            begin += motion.seconds
        first = 1 if len(times) > 1 else 0  # the motions begin where the arm waits
        self._times, self._joints = np.concatenate(times[first:]), np.concatenate(joints[first:])
        self.seconds = begin

    def at(self, time: float | np.ndarray) -> np.ndarray:
        """Joint positions [rad] at times from the beginning of the action [s].

        Returns:
            (dof,) at one time, (T, dof) at T of them
        """
        return np.stack([np.interp(time, self._times, q) for q in self._joints.T], axis=-1)
