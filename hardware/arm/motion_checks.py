"""Whether a motion keeps `SafetyLimits`: checks that know an arm and limits, but no robot.

Each raises `SafetyViolation`, whose message begins with the name of the limit. A start is measured,
not commanded: it may be beyond a limit by what an arrival may miss, and a path may leave from there
but not go further out.

A speed in joint space says nothing about the hand's: it is lowered to what keeps the TCP's limits
along the path. So is that of a straight line whose start has sagged a little above its target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warp_deform.errors import InputError

from .arguments import check_pose, real_number
from .joint_path import corner_cuts, path_pieces
from .limits import LIMIT_NAMES, PATH_TOLERANCE, SafetyLimits, dense_path
from .panda import PandaKinematics
from .path_speed import fitting_share
from .robot import RobotState, SafetyViolation
from .sinking import LEVEL, sunk_after
from .straight_line import StraightLine, distance, straight_line

__all__ = [
    "CheckedLine",
    "CheckedPath",
    "LineSolver",
    "MotionChecks",
    "as_lines",
]

LineSolver = Callable[..., StraightLine]
"""What finds the joint positions along a straight line: the signature of `straight_line`."""

# How far the robot's own pose may be from the nominal arm's: more means that another hand or
# another end effector is set in Desk, and the floor would be wrong by as much.
_MODEL_TOLERANCE = 3e-3, 0.02  # [m], [rad]
# How far from the straight line the solver's joint positions may put the TCP.
_LINE_TOLERANCE, _END_TOLERANCE, _END_TURN = 1e-3, 2e-4, 1e-3  # [m], [m], [rad]
# Rounding, and what an inverse kinematics leaves over: counted as within.
_ROUNDING, _SOLVED = 1e-9, 3e-5  # [m], [rad]
# Lowest speeds that are meant [m/s], [share], and forces [N]: less is a slip, and never ends.
_SLOWEST, _SLOWEST_SHARE, _SOFTEST = 1e-4, 1e-4, 0.1


@dataclass(frozen=True)
class CheckedLine:
    """A straight line that keeps the limits.

    Attributes:
        q: where the solver's answer ends [rad], (7,)
        speed: of the TCP [m/s], at most what was commanded
        sunk: how far the hand has then sunk without a stop force [m]
    """

    q: np.ndarray
    speed: float
    sunk: float


@dataclass(frozen=True)
class CheckedPath:
    """A path in joint space that keeps the limits.

    Attributes:
        points: waypoints without repetitions [rad], (N, 7)
        speed: share of the joints' greatest speeds, at most what was commanded
    """

    points: np.ndarray
    speed: float


@dataclass(frozen=True)
class MotionChecks:
    """The checks of one arm and its limits.

    Attributes:
        limits: what is let through
        arm: the nominal kinematics
        line_solver: inverse kinematics of straight lines; its answers are checked, not believed
    """

    limits: SafetyLimits
    arm: PandaKinematics
    line_solver: LineSolver = straight_line

    def check_reading(self, state: RobotState) -> None:
        """Refuse a reading that is not finite, or whose pose is not that of the nominal arm."""
        if not (np.isfinite(state.q).all() and np.isfinite(state.base_T_tcp).all()):
            raise SafetyViolation("the robot's reading is not finite", advice="restart the robot")
        off, turned = distance(self.arm.pose(state.q), state.base_T_tcp)
        if off > _MODEL_TOLERANCE[0] or turned > _MODEL_TOLERANCE[1]:
            raise SafetyViolation(
                f"end effector: the robot's TCP is {1e3 * off:.1f} mm and {turned:.3f} rad from "
                f"the Franka hand's (allowed: {1e3 * _MODEL_TOLERANCE[0]:g} mm, "
                f"{_MODEL_TOLERANCE[1]:g} rad)",
                advice="choose the Franka hand as the end effector in Desk",
            )

    def check_share(self, speed: float) -> float:
        """Return a share of the joints' speeds; refuse one beyond `max_joint_speed`."""
        return _within(
            "max_joint_speed", "speed", speed, _SLOWEST_SHARE, self.limits.max_joint_speed
        )

    def check_grasp_force(self, force_N: float) -> float:
        """Return a force of the fingers [N]; refuse one beyond `max_grasp_force_N`."""
        return _within(
            "max_grasp_force_N", "force_N", force_N, _SOFTEST, self.limits.max_grasp_force_N, " N"
        )

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

    def check_waypoints(self, q: np.ndarray, *, rounding: float = _ROUNDING) -> np.ndarray:
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
        poses = self.arm.poses(q)
        self._check_poses(poses, rounding, what="a waypoint is beyond")
        return poses

    def check_joint_path(
        self, start: np.ndarray, points: np.ndarray, *, speed: float
    ) -> CheckedPath:
        """Refuse a motion from `start` (7,) through `points` (N, 7) [rad]; it stops on no contact.

        So it has to stay above `contact_height_m`. Checked is what the backend executes: without
        waypoints that repeat the one before, and with corners that may be rounded.
        """
        speed = self.check_share(speed)
        self.check_waypoints(points)
        pieces = [piece for _, piece in path_pieces(start, points)]
        # Without pieces the arm has all but reached the last waypoint.
        waypoints = np.vstack(pieces) if pieces else points[-1:]
        path = np.vstack([start, waypoints])
        self._check_steps(path)
        dense = dense_path(path)
        poses = self.arm.poses(dense)
        cuts = [self.arm.poses(dense_path(cut)) for cut in (corner_cuts(path) if pieces else [])]
        around = np.concatenate([poses, *cuts])
        self._check_along(around)
        limits, heights = self.limits, self.limits.height(around)
        low = limits.contact_height_m
        if (
            heights[0] < low - limits.arrival_tolerance_m
            or heights.min() < min(low, heights[0]) - PATH_TOLERANCE
            or limits.height(self.arm.poses(waypoints)).min() < low - _ROUNDING
        ):
            raise SafetyViolation(
                f"contact_height_m: a motion in joint space comes within {heights.min():.3f} m "
                f"of the table, {low:g} m allowed",
                advice="go up and down in straight lines",
            )
        fits = fitting_share(
            dense, poses, max_speed=limits.max_speed, max_descent_speed=limits.max_descent_speed
        )
        return CheckedPath(waypoints, min(speed, fits))

    def check_line(
        self,
        q: np.ndarray,
        start: np.ndarray,
        target: np.ndarray,
        *,
        speed: float,
        stop_force_N: float | None,
        sunk: float,
    ) -> CheckedLine:
        """Refuse a straight line.

        Args:
            q: joint positions at the start [rad], (7,)
            start: pose at the start [m], (4, 4)
            target: pose at the end [m], (4, 4)
            speed: of the TCP [m/s]
            stop_force_N: force that ends it [N], or None
            sunk: how far the hand has sunk without a stop force [m]

        Raises:
            SafetyViolation: a limit is broken, or the solver's answer is not this line
            UnreachablePose: the solver found none
            InputError: a speed or force is no number
        """
        limits = self.limits
        speed = _within("max_speed", "speed", speed, _SLOWEST, limits.max_speed, " m/s")
        if stop_force_N is not None:
            _within(
                "max_contact_force_N",
                "stop_force_N",
                stop_force_N,
                _SOFTEST,
                limits.max_contact_force_N,
                " N",
            )
        self._check_poses(target[None], _ROUNDING, what="a waypoint is beyond")
        height = float(limits.height(target))
        stops = stop_force_N is not None
        descends = float(limits.height(start)) - height > LEVEL
        if descends:
            _within("max_descent_speed", "speed", speed, 0.0, limits.max_descent_speed, " m/s")
        sinks = sunk_after(limits, start, target, sunk=sunk, stops=stops)
        low = height < limits.contact_height_m
        if not stops and low and (descends or sinks > max(sunk, LEVEL)):
            raise SafetyViolation(
                f"contact_height_m: a descent to {height:.3f} m above the table has no stop "
                f"force, needed below {limits.contact_height_m:g} m",
                advice="give the descent a stop_force_N",
            )
        drop = float(start[2, 3] - target[2, 3])
        if drop > 0.0:
            length = float(np.linalg.norm(target[:3, 3] - start[:3, 3]))
            speed = min(speed, limits.max_descent_speed * length / drop)
        points = np.asarray(self.line_solver(self.arm, q, target, speed=speed).q, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 7 or not len(points):
            raise SafetyViolation(
                f"inverse kinematics: its answer has shape {points.shape}, not (N, 7)"
            )
        # The pose itself was checked exactly; the solver meets it to a hundredth of a millimetre.
        already = np.maximum(limits.excess(self.arm.poses(q[None]))[0].max(), 0.0)
        poses = self.check_waypoints(points, rounding=already + _SOLVED)
        path = np.vstack([q, points])
        self._check_steps(path)
        self._check_along(self.arm.poses(dense_path(path)))
        self._check_on_line(self.arm.pose(q), target, poses)
        return CheckedLine(points[-1], speed, sinks)

    def _check_steps(self, path: np.ndarray) -> None:
        """Refuse a path (N, 7) [rad] that jumps between two waypoints."""
        step = float(np.abs(np.diff(path, axis=0)).max())
        if step > self.limits.max_joint_step_rad:
            raise SafetyViolation(
                f"max_joint_step_rad: {step:.2f} rad between two waypoints, "
                f"{self.limits.max_joint_step_rad:g} allowed"
            )

    def _check_along(self, poses: np.ndarray) -> None:
        """Check poses (M, 4, 4) along a path, the first of which is where the arm stands."""
        already = np.maximum(self.limits.excess(poses[:1])[0], 0.0)
        self._check_poses(poses, already + _SOLVED, what="the path goes beyond")

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


def _within(limit: str, name: str, value: float, low: float, high: float, unit: str = "") -> float:
    """Return the argument `name` as a number; refuse one that is not from `low` to `high`."""
    number = real_number(name, value)
    if not low <= number <= high or number <= 0.0:  # also when it is not a number
        raise SafetyViolation(
            f"{limit}: {number:g}{unit} is commanded, {low:g} to {high:g}{unit} allowed"
        )
    return number


def as_lines(lines: object) -> list[tuple[np.ndarray, float, float | None]]:
    """Return lines as triples whose poses are copies, or refuse what is none."""
    try:
        triples = [(target, speed, force) for target, speed, force in lines]  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise InputError("lines: a list of (pose, speed, stop force) is needed") from error
    return [(check_pose(target), speed, force) for target, speed, force in triples]
