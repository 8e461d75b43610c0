"""Whether a motion keeps `SafetyLimits`: checks that know an arm and limits, but no robot.

Each raises `SafetyViolation`, whose message begins with the name of the limit. A start is measured,
not commanded: it may be beyond a limit by what an arrival may miss, and a path may leave from there
but not go further out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .panda_arm import PandaKinematics
from .robot import SafetyViolation
from .safety_limits import LIMIT_NAMES, PATH_TOLERANCE, SafetyLimits, dense_path
from .straight_line import StraightLine, distance, straight_line

__all__ = ["MotionChecks", "Planner"]

Planner = Callable[..., StraightLine]
"""What solves a straight line: the signature of `straight_line`."""

# How far from the straight line the planner's joint positions may put the TCP.
_LINE_TOLERANCE, _END_TOLERANCE, _END_TURN = 1e-3, 2e-4, 1e-3  # [m], [m], [rad]
# Rounding, and what an inverse kinematics leaves over: counted as within.
_ROUNDING, _SOLVED = 1e-9, 3e-5  # [m], [rad]
_LEVEL = 1e-3  # [m]: a motion that ends less than this lower is no descent


class MotionChecks:
    """The checks of one arm and its limits.

    Args:
        limits: what is let through
        arm: the nominal kinematics
        planner: inverse kinematics of straight lines; its answers are checked, not believed
    """

    def __init__(
        self, limits: SafetyLimits, arm: PandaKinematics, *, planner: Planner = straight_line
    ) -> None:
        self.limits = limits
        self._arm = arm
        self._plan = planner

    @staticmethod
    def check_value(limit: str, value: float, high: float, unit: str = "") -> None:
        """Refuse a value that is not above 0 and at most `high`."""
        if not 0.0 < value <= high:  # also when it is not a number
            raise SafetyViolation(f"{limit}: {value:g}{unit} is commanded, {high:g}{unit} allowed")

    def check_start(self, base_T_tcp: np.ndarray) -> None:
        """Refuse to move from a measured pose (4, 4) that is farther out than an arrival may be."""
        allowed = np.full(len(LIMIT_NAMES), self.limits.arrival_tolerance_m)
        allowed[-1] = self.limits.arrival_tolerance_rad
        self._check_poses(
            base_T_tcp[None],
            allowed,
            what="the arm stands beyond",
            advice="guide it back into the workspace by hand",
        )

    def check_way_points(self, q: np.ndarray, *, rounding: float = _ROUNDING) -> np.ndarray:
        """Refuse joint positions (N, 7) [rad] near a joint's limit or with the hand beyond a limit.

        Returns:
            their poses, (N, 4, 4)
        """
        if not np.isfinite(q).all():
            raise SafetyViolation("inverse kinematics: its answer is not finite")
        beyond = np.maximum(self.limits.q_min - q, q - self.limits.q_max)
        if beyond.max() > 0.0:
            row, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
            raise SafetyViolation(
                f"joint_margin: joint {joint + 1} at {q[row, joint]:.3f} rad, allowed: "
                f"{self.limits.q_min[joint]:.3f} to {self.limits.q_max[joint]:.3f}"
            )
        poses = self._arm.poses(q)
        self._check_poses(poses, rounding, what="a way-point is beyond")
        return poses

    def check_joint_path(self, start: np.ndarray, points: np.ndarray) -> None:
        """Refuse a motion from `start` (7,) through `points` (N, 7) [rad]; it stops on no contact.

        So it has to stay above `contact_height_m`.
        """
        ends = self.check_way_points(points)
        heights = self.limits.height(self._check_between(start, points))
        low = self.limits.contact_height_m
        if (
            heights[0] < low - self.limits.arrival_tolerance_m
            or heights.min() < min(low, heights[0]) - PATH_TOLERANCE
            or self.limits.height(ends).min() < low - _ROUNDING
        ):
            raise SafetyViolation(
                f"contact_height_m: a motion in joint space comes within {heights.min():.3f} m "
                f"of the table, {low:g} m allowed",
                advice="go up and down in straight lines",
            )

    def check_line(
        self,
        q: np.ndarray,
        start: np.ndarray,
        target: np.ndarray,
        *,
        speed: float,
        stop_force_N: float | None,
    ) -> np.ndarray:
        """Refuse a straight line; returns where the planner's answer ends [rad], (7,).

        Args:
            q: joint positions at the start [rad], (7,)
            start, target: poses, (4, 4)
            speed: of the TCP [m/s]
            stop_force_N: force that ends it [N], or None

        Raises:
            SafetyViolation: a limit is broken, or the planner's answer is not this line
            UnreachablePose: the planner found none
        """
        limits = self.limits
        self.check_value("max_speed", speed, limits.max_speed, " m/s")
        if stop_force_N is not None:
            self.check_value("max_contact_force_N", stop_force_N, limits.max_contact_force_N, " N")
        self._check_poses(target[None], _ROUNDING, what="a way-point is beyond")
        height = float(limits.height(target))
        if float(limits.height(start)) - height > _LEVEL:
            self.check_value("max_descent_speed", speed, limits.max_descent_speed, " m/s")
            if height < limits.contact_height_m and stop_force_N is None:
                raise SafetyViolation(
                    f"contact_height_m: a descent to {height:.3f} m above the table has no stop "
                    f"force, needed below {limits.contact_height_m:g} m",
                    advice="give the descent a stop_force_N",
                )
        points = np.asarray(self._plan(self._arm, q, target, speed=speed).q, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 7 or not len(points):
            raise SafetyViolation(
                f"inverse kinematics: its answer has shape {points.shape}, not (N, 7)"
            )
        # The pose itself was checked exactly; the planner meets it to a hundredth of a millimetre.
        already = np.maximum(limits.excess(self._arm.poses(q[None]))[0].max(), 0.0)
        poses = self.check_way_points(points, rounding=already + _SOLVED)
        self._check_between(q, points)
        self._check_on_line(self._arm.pose(q), target, poses)
        end: np.ndarray = points[-1]
        return end

    def _check_between(self, start: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Check what lies between way-points; returns poses along the path, (M, 4, 4)."""
        path = np.vstack([start, points])
        step = float(np.abs(np.diff(path, axis=0)).max())
        if step > self.limits.max_joint_step_rad:
            raise SafetyViolation(
                f"max_joint_step_rad: {step:.2f} rad between two way-points, "
                f"{self.limits.max_joint_step_rad:g} allowed"
            )
        poses = self._arm.poses(dense_path(path))
        already = np.maximum(self.limits.excess(poses[:1])[0], 0.0)
        self._check_poses(poses, already + _SOLVED, what="the path goes beyond")
        return poses

    def _check_poses(
        self,
        poses: np.ndarray,
        allowed: float | np.ndarray,
        *,
        what: str,
        advice: str | None = None,
    ) -> None:
        """Refuse poses (N, 4, 4) more than `allowed`, one value or (8,), beyond a limit."""
        excess = self.limits.excess(poses)
        over = excess - allowed
        if not over.max() <= 0.0:
            row, column = np.unravel_index(int(np.argmax(over)), over.shape)
            unit = "rad" if column == len(LIMIT_NAMES) - 1 else "m"
            where = ", ".join(f"{x:.3f}" for x in poses[row, :3, 3])
            raise SafetyViolation(
                f"{LIMIT_NAMES[column]}: {what} it by {excess[row, column]:.4f} {unit}, "
                f"at ({where}) m",
                advice=advice,
            )

    @staticmethod
    def _check_on_line(start: np.ndarray, target: np.ndarray, poses: np.ndarray) -> None:
        off, turned = distance(poses[-1], target)
        if off > _END_TOLERANCE or turned > _END_TURN:
            raise SafetyViolation(
                f"inverse kinematics: its answer ends {1e3 * off:.1f} mm and {turned:.3f} rad "
                "from the target"
            )
        line = target[:3, 3] - start[:3, 3]
        offsets = poses[:, :3, 3] - start[:3, 3]
        shares = np.clip(offsets @ line / max(float(line @ line), 1e-12), 0.0, 1.0)
        aside = float(np.linalg.norm(offsets - shares[:, None] * line, axis=1).max())
        if aside > _LINE_TOLERANCE:
            raise SafetyViolation(
                f"inverse kinematics: its answer leaves the line by {1e3 * aside:.1f} mm"
            )
