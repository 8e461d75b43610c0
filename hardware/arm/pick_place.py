"""The pick-and-place primitive on a robot, with the hand pointing down.

Hover, open, descend until contact, take hold, lift, carry, lower until contact, let go, retreat,
home. Every height is above the measured table. Every waypoint is checked before anything moves, and
once more when it is its turn. What the fingers hold is measured after the grasp and again after the
lift: a cable that was missed or lost is an outcome, not an error.

Source: Seita et al., ICRA 2021, section on physical experiments, for the primitive, the openings
and the force of the fingers; heights are for the vendor's fingers on a flat table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.tasks.strand_grasp import wrap_half_turn

from .arguments import real_number
from .robot import MotionError, SafetyViolation, UnreachablePose
from .safe_robot import SafeRobot
from .table_plane import TablePlane

__all__ = [
    "PickPlaceAction",
    "PickPlaceConfig",
    "PickPlaceOutcome",
    "PickPlaceResult",
    "execute",
    "hand_down",
    "refusal",
    "waypoints",
]

# Joint 7 turns so far either way, less the safety limits' margin [rad].
_MAX_JOINT_7 = 2.6


@dataclass(frozen=True, kw_only=True)
class PickPlaceConfig:
    """Heights above the table and what the fingers do."""

    hover_m: float = 0.07
    """Before picking and after placing [m]."""
    grasp_m: float = 0.010
    """TCP when taking hold [m]: the fingertips, 9 mm lower, just above the foam."""
    lift_m: float = 0.05
    """While carrying [m]: the higher, the more of the chain folds up under the hand when it is
    lowered."""
    short_lift_m: float = 0.04
    """While carrying not farther than `short_distance_m` [m]."""
    short_distance_m: float = 0.075
    """What counts as short [m]: 40 pixels of 1.9 mm."""
    place_m: float = 0.015
    """TCP when letting go [m]."""
    contact_slack_m: float = 0.010
    """How much higher than planned a descent may meet something and still count as arrived [m]:
    more is an obstacle."""
    back_off_m: float = 0.002
    """How far to rise after a contact before the fingers move [m]: they must not rub."""
    open_width_m: float = 0.035
    """Opening of the fingers on the way down [m]: less takes no neighbouring strand along."""
    release_width_m: float = 0.030
    """Opening that lets the cable go [m]."""
    grasp_width_m: float = 0.010
    """Width up to which what is between the fingers can be the cable [m]."""
    grasp_force_N: float = 10.0
    """Force of the fingers [N]."""
    speed: float = 0.10
    """Straight and level or up [m/s]."""
    descent_speed: float = 0.05
    """Down [m/s]."""
    stop_force_N: float = 8.0
    """Force at which a descent has met something [N]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = real_number(f"pick_place: {field.name}", getattr(self, field.name))
            if not 0.0 <= value < math.inf:
                raise InputError(f"pick_place: {field.name} is {value}, needed is 0 or more")
        if not self.grasp_m < self.hover_m or not self.place_m < self.short_lift_m <= self.lift_m:
            raise InputError(
                "pick_place: heights need grasp_m < hover_m and place_m < short_lift_m <= lift_m"
            )
        if not self.grasp_width_m < min(self.open_width_m, self.release_width_m):
            raise InputError("pick_place: the fingers must open wider than grasp_width_m")


@dataclass(frozen=True)
class PickPlaceAction:
    """What to do, in the base frame.

    Attributes:
        pick_xy: where to take the cable [m]
        pick_yaw: the cable's tangent there [rad]; the fingers open across it
        place_xy: where to let it go [m]
        place_yaw: the tangent's direction there [rad]: the hand turns by the difference
    """

    pick_xy: tuple[float, float]
    pick_yaw: float
    place_xy: tuple[float, float]
    place_yaw: float

    def __post_init__(self) -> None:
        values = (*self.pick_xy, self.pick_yaw, *self.place_xy, self.place_yaw)
        for value in values:
            real_number("an action's number", value)
        if not all(math.isfinite(value) for value in values):
            raise InputError(f"an action's numbers must be finite, not {values}")


class PickPlaceOutcome(StrEnum):
    """What became of an action."""

    PLACED = "placed"
    MISSED_GRASP = "missed_grasp"
    """The fingers held nothing, after closing or after the lift."""
    OBSTRUCTED = "obstructed"
    """A descent met something well above the table; the hand went up again."""
    ABORTED = "aborted"
    """The robot stopped itself on the way, was recovered, and let go of what it held."""


@dataclass(frozen=True)
class PickPlaceResult:
    """What was done.

    Attributes:
        outcome: what became of it
        base_T_pick: pose at which the fingers closed, or where they would have [m], (4, 4)
        base_T_place: pose at which they opened [m], (4, 4); None where it did not come to that
        width_after_grasp_m: between the fingers after closing [m]; None before
        width_after_lift_m: the same after lifting [m]; None before
        lift_m: height of carrying [m]
        max_force_N: greatest force on the hand at the ends of the motions [N]
    """

    outcome: PickPlaceOutcome
    base_T_pick: np.ndarray
    base_T_place: np.ndarray | None
    width_after_grasp_m: float | None
    width_after_lift_m: float | None
    lift_m: float
    max_force_N: float


def waypoints(
    action: PickPlaceAction, table: TablePlane, config: PickPlaceConfig | None = None
) -> dict[str, np.ndarray]:
    """Return the poses of an action by name, in their order, (4, 4) each [m].

    Raises:
        InputError: the last joint cannot turn that far
    """
    config = config or PickPlaceConfig()
    pick_yaw, place_yaw = _yaws(action)
    lift = _lift(action, config)
    return {
        "hover": hand_down(action.pick_xy, config.hover_m, pick_yaw, table),
        "grasp": hand_down(action.pick_xy, config.grasp_m, pick_yaw, table),
        "lift": hand_down(action.pick_xy, lift, pick_yaw, table),
        "carry": hand_down(action.place_xy, lift, place_yaw, table),
        "place": hand_down(action.place_xy, config.place_m, place_yaw, table),
        "retreat": hand_down(action.place_xy, config.hover_m, place_yaw, table),
    }


def refusal(
    robot: SafeRobot, action: PickPlaceAction, config: PickPlaceConfig
) -> WarpDeformError | None:
    """Return why an action would be refused, None where it would not; moves nothing.

    Raises:
        RobotError: the robot accepts no motion at all now
    """
    try:
        robot.check_lines(_lines(waypoints(action, robot.limits.table, config), config))
    except (SafetyViolation, UnreachablePose, InputError) as error:
        return error
    return None


def _lines(
    poses: dict[str, np.ndarray], config: PickPlaceConfig
) -> list[tuple[np.ndarray, float, float | None]]:
    """Return target, speed and stop force of the straight lines through an action's poses."""
    down = (config.descent_speed, config.stop_force_N)
    # The hover pose is usually below where the arm is, so it is approached at descent speed.
    speeds = {"hover": down, "grasp": down, "place": down}
    return [(T, *speeds.get(name, (config.speed, None))) for name, T in poses.items()]


def execute(
    robot: SafeRobot, action: PickPlaceAction, config: PickPlaceConfig | None = None
) -> PickPlaceResult:
    """Do it, from wherever the hand is above the table, and go home.

    Raises:
        SafetyViolation, UnreachablePose, InputError: refused; before the first motion nothing has
            moved, later the arm stands still with the gripper as it is
        RobotError: see `SafeRobot`
    """
    config = config or PickPlaceConfig()
    return _Execution(robot, action, config).run()


class _Execution:
    """One action on its way."""

    def __init__(self, robot: SafeRobot, action: PickPlaceAction, config: PickPlaceConfig) -> None:
        self._robot = robot
        self._config = config
        self._poses = waypoints(action, robot.limits.table, config)
        self._lift = _lift(action, config)
        self._force = 0.0
        self._widths: list[float] = []
        self._pick = self._poses["grasp"]
        self._place: np.ndarray | None = None

    def run(self) -> PickPlaceResult:
        robot, config = self._robot, self._config
        robot.check_lines(_lines(self._poses, config))
        self._go("hover", contact=True)
        robot.open_gripper(config.open_width_m)
        if not self._descend("grasp"):
            self._rise("hover")
            return self._end(PickPlaceOutcome.OBSTRUCTED)
        held = robot.grasp(width_m=config.grasp_width_m, force_N=config.grasp_force_N)
        self._widths.append(robot.state().gripper_width_m)
        if held:
            self._go("lift")
            held = robot.holds()
            self._widths.append(robot.state().gripper_width_m)
        if not held:
            self._rise("hover")
            robot.open_gripper(config.open_width_m)
            return self._end(PickPlaceOutcome.MISSED_GRASP)
        self._go("carry")
        # A contact above the place is no obstacle to letting go: the cable hangs below the hand.
        self._descend("place")
        self._place = robot.state().base_T_tcp
        robot.open_gripper(config.release_width_m)
        self._rise("retreat")
        return self._end(PickPlaceOutcome.PLACED)

    def _go(self, name: str, *, contact: bool = False) -> None:
        """Move to a waypoint; with `contact` gently, and something in the way is an error."""
        config, pose = self._config, self._poses[name]
        if not contact:
            self._robot.move_linear(pose, speed=config.speed)
        elif self._robot.move_linear(
            pose, speed=config.descent_speed, stop_force_N=config.stop_force_N
        ).contact:
            raise MotionError(f"the hand met something on its way to {name}")
        self._feel()

    def _rise(self, name: str) -> None:
        """Move up to a waypoint, from a hand that may be higher already."""
        if self._robot.state().base_T_tcp[2, 3] < self._poses[name][2, 3]:
            self._go(name)

    def _descend(self, name: str) -> bool:
        """Go down until contact; returns whether that was near the waypoint."""
        config = self._config
        result = self._robot.move_linear(
            self._poses[name], speed=config.descent_speed, stop_force_N=config.stop_force_N
        )
        self._feel()
        reached = result.base_T_tcp
        if name == "grasp":
            self._pick = reached
        if not result.contact:
            return True
        if reached[2, 3] - self._poses[name][2, 3] > config.contact_slack_m:
            return name == "place"
        above = self._poses[name].copy()
        above[2, 3] = max(reached[2, 3] + config.back_off_m, above[2, 3])
        self._robot.move_linear(above, speed=config.speed)
        return True

    def _feel(self) -> None:
        force = self._robot.state().force_N[:3]
        self._force = max(self._force, float(np.linalg.norm(force)))

    def _end(self, outcome: PickPlaceOutcome) -> PickPlaceResult:
        self._robot.home()
        return PickPlaceResult(
            outcome=outcome,
            base_T_pick=self._pick,
            base_T_place=self._place,
            width_after_grasp_m=self._widths[0] if self._widths else None,
            width_after_lift_m=self._widths[1] if len(self._widths) > 1 else None,
            lift_m=self._lift,
            max_force_N=self._force,
        )


def _lift(action: PickPlaceAction, config: PickPlaceConfig) -> float:
    distance = math.dist(action.pick_xy, action.place_xy)
    return config.short_lift_m if distance <= config.short_distance_m else config.lift_m


def _yaws(action: PickPlaceAction) -> tuple[float, float]:
    """Return the hand's turns at pick and place [rad]: their difference is the action's.

    A jaw may take the cable from either side; the one is chosen that keeps joint 7 nearer its
    middle. With the hand down and the elbow in the arm's plane that joint stands at a quarter of pi
    plus the direction of the arm minus the hand's turn.
    """
    turn = math.remainder(action.place_yaw - action.pick_yaw, 2.0 * math.pi)
    pick = wrap_half_turn(action.pick_yaw)

    def joint_7(yaw: float) -> float:
        ends = ((action.pick_xy, yaw), (action.place_xy, yaw + turn))
        return max(abs(math.pi / 4 + math.atan2(y, x) - angle) for (x, y), angle in ends)

    best = min((pick, pick + math.pi, pick - math.pi), key=joint_7)
    if joint_7(best) > _MAX_JOINT_7:
        raise InputError(
            f"the hand cannot turn from {pick:.2f} rad by {turn:.2f} rad; turn the cable less"
        )
    return best, best + turn


def hand_down(xy: tuple[float, float], height: float, yaw: float, table: TablePlane) -> np.ndarray:
    """Return the pose (4, 4) [m] above a point of the table, the hand straight down.

    Args:
        xy: the point, x and y in the base frame [m]
        height: of the TCP above the table [m]
        yaw: direction of the hand's x axis [rad]
        table: the measured table
    """
    c, s = math.cos(yaw), math.sin(yaw)
    z = float(table.z(np.array(xy))) + height
    return np.array([[c, s, 0, xy[0]], [s, -c, 0, xy[1]], [0, 0, -1, z], [0, 0, 0, 1.0]])
