"""The pick-and-place primitive: an action becomes waypoints of the tip over simulated time.

Source: Seita et al., ICRA 2021, appendix on the action primitive. The tip goes above the pick
point, descends until it meets something, takes it, lifts it, carries it above the place point,
lowers it until it meets something, waits, lets go and retreats. Where the original moves joints a
fixed angle a control tick of wall time, the tip here follows straight lines in simulated time, with
IK waypoints along them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from ..objects.bag import Bag
from ..objects.box import Box
from ..objects.cable import Cable
from ..objects.cloth import Cloth
from ..objects.scene_object import SceneObject, box_of, is_surface
from ..rollout.rollouts import GripPath
from ..support.quaternion import quat_from_yaw, quat_inverse, quat_multiply, quat_rotate
from .arm import Robot

__all__ = [
    "Grasp",
    "Motion",
    "Outcome",
    "PrimitiveConfig",
    "approach",
    "carry",
    "find_grasp",
    "solve_joints",
]


_GENTLE_PIECES = 13
"""Waypoints of a gentle stretch."""
BEAD_FIRST = 0.006
"""A bead that a descending tip meets so little below a vertex of the shell is taken instead [m]."""


class Outcome(StrEnum):
    """What became of an action."""

    PLACED = "placed"
    MISSED = "missed"
    """The descending tip met only the table."""
    UNREACHABLE = "unreachable"
    """The arm cannot reach a waypoint tip-down; nothing was moved."""
    INVALID = "invalid"
    """A guard of the solver fired: the state cannot be trusted."""


@dataclass(frozen=True, kw_only=True)
class PrimitiveConfig:
    """Speeds and heights that all tasks share; lift and loaded speed belong to a task's stage."""

    unloaded_speed: float = 1.0
    """Speed of the empty tip [m/s]."""
    hover: float = 0.30
    """Height of the tip between actions, where reachable [m]."""
    turn_speed: float = 2.5
    """Fastest turn about the tip's axis [rad/s]; the last joints do 3.1 (UR5) and 2.6 (Panda)."""
    dwell: float = 0.2
    """Wait between lowering and letting go [s]; without it a dragged bead hops when released."""
    sheet_release: float = 0.0
    """Height above the table at which a vertex of a fabric or a bag is let go [m]."""
    sheet_meets: bool = False
    """Whether a vertex of a fabric or a bag is let go as soon as it meets something below it."""
    tip_radius: float = 0.001
    """Radius of the suction tip [m]."""
    spacing: float = 0.10
    """Largest distance between joint waypoints along a straight line [m]."""
    turn_spacing: float = 0.5
    """Largest turn between them [rad]."""


LIFT = (0.04, 0.40)
"""Least and greatest height [m] at which the tip carries what it holds."""


@dataclass(frozen=True)
class Stage:
    """How high the tip carries what it holds [m], and how fast [m/s].

    Attributes:
        lower_speed: of the descent over the place point [m/s]; None: as fast as it carries
        pause: rest after lifting and before lowering [s], in which what hangs from the tip calms
        gentle: whether lift, carry and descent begin and end slowly; their mean speed is then
            `speed`
    """

    lift: float
    speed: float
    lower_speed: float | None = None
    pause: float = 0.0
    gentle: bool = False


@dataclass(frozen=True, eq=False)
class Grasp:
    """What a descending tip met first: a particle or a body, with its pose in the tip's frame.

    Attributes:
        height: of the tip at contact [m]
        offset: (3,) [m], as in `GripPath`
        turn: (4,) quat_xyzw, as in `GripPath`
    """

    height: float
    offset: np.ndarray
    turn: np.ndarray
    particle: int | None = None
    body: int | None = None
    sheet: bool = False
    """Whether the particle is a vertex of a fabric or a bag."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A stretch of the tip's motion: waypoints (K, 4) x, y, z [m], yaw [rad] at times (K,) [s]."""

    times: np.ndarray
    waypoints: np.ndarray

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])


def find_grasp(
    xy_yaw: np.ndarray,
    objects: Sequence[SceneObject],
    particle_q: np.ndarray,
    body_q: np.ndarray,
    config: PrimitiveConfig,
) -> Grasp | None:
    """What a tip that descends at x, y (with a yaw) meets first above the table, or None.

    Beads count with their visual radius: the paper's beads are 1 cm cubes, whose corners reach as
    far. Fabrics and bags are taken by the vertex that first comes within the `grasp_reach` of their
    config, as the original's suction does. particle_q (P, 3); body_q (B, 7).
    """
    x, y, yaw = xy_yaw
    best: tuple[float, int | None, int | None] | None = None
    for item in objects:
        if isinstance(item, Cable):
            centres = particle_q[item.particles.start : item.particles.stop]
            reach = item.config.visual_radius + config.tip_radius
            away = np.hypot(centres[:, 0] - x, centres[:, 1] - y)
            tops = centres[:, 2] + np.sqrt(np.maximum(reach**2 - away**2, 0.0))
            tops[away > reach] = -np.inf
            i = int(np.argmax(tops))
            if np.isfinite(tops[i]) and (best is None or tops[i] > best[0]):
                best = float(tops[i]), item.particles.start + i, None
        elif isinstance(item, Cloth | Bag):
            met = _sheet_vertex(x, y, item, particle_q)
            if met is not None and (best is None or met[0] > best[0]):
                best = *met, None
        else:
            top = _box_top(x, y, item, body_q[item.body])
            if top is not None and (best is None or top > best[0]):
                best = top, None, item.body
    if best is None:
        return None
    height, particle, body = best
    tip = np.array([x, y, height])
    back = quat_from_yaw(-yaw)
    if particle is not None:
        offset = quat_rotate(back, particle_q[particle] - tip)
        sheet = is_surface(objects, particle)
        return Grasp(height, offset, quat_from_yaw(0.0), particle=particle, sheet=sheet)
    assert body is not None
    com = box_of(objects, body).config.inertia()[0]
    centre = body_q[body, :3] + quat_rotate(body_q[body, 3:], com)
    turn = quat_multiply(back, body_q[body, 3:])
    return Grasp(height, quat_rotate(back, centre - tip), turn, body=body)


def approach(
    start: np.ndarray, pick: np.ndarray, hover: float, height: float, config: PrimitiveConfig
) -> Motion:
    """From `start` (4,) over the pick point (3,) x, y, yaw at `hover` down to `height` [m].

    The tip turns the short way to the pick's yaw, which it has without whole turns at the end.
    """
    start = np.array([*start[:3], pick[2] - _half_turn(pick[2] - start[3])])
    above = np.array([pick[0], pick[1], hover, pick[2]])
    contact = np.array([pick[0], pick[1], height, pick[2]])
    return _straight([start, above, contact], config.unloaded_speed, config)


def carry(
    action: np.ndarray,
    grasp: Grasp,
    stage: Stage,
    floor: float,
    hover: float,
    config: PrimitiveConfig,
) -> tuple[Motion, GripPath]:
    """Lift, carry and lower what `grasp` holds, then wait.

    A bead or a body is lowered until it meets something, a vertex of a fabric or a bag only where
    `sheet_meets` says so, else to a fixed height. The retreat to `hover` follows the release and is
    in the motion only. A body that is taken above the action's lift, as one that lies on a bag can
    be, is carried at the height it was taken at: it would be pressed through what lies under it.

    Args:
        action: pick x, y, yaw, place x, y, yaw, lift (7,) [m, rad]
        grasp: what the tip holds, and its height when it took it
        stage: speeds and pauses
        floor: lowest height of the tip over the place point [m], where what is held rests on the
            table
        hover: height of the tip after the release [m]
        config: of the primitive

    Returns:
        The tip's motion with its retreat, and the path of what it holds, for the solver.
    """
    pick, place, lift = action[:3], action[3:6], float(action[6])
    if grasp.body is not None:
        lift = max(lift, grasp.height)
    yaw = pick[2] + _half_turn(place[2] - pick[2])
    bottom = min(floor + (config.sheet_release if grasp.sheet else 0.0), lift)
    points = [
        np.array([pick[0], pick[1], grasp.height, pick[2]]),
        np.array([pick[0], pick[1], lift, pick[2]]),
        np.array([place[0], place[1], lift, yaw]),
        np.array([place[0], place[1], bottom, yaw]),
    ]
    up = _straight(points[:2], stage.speed, config)
    across = _straight(points[1:3], stage.speed, config)
    down = _straight(points[2:], stage.lower_speed or stage.speed, config)
    parts = [_gentle(part) for part in (up, across, down)] if stage.gentle else [up, across, down]
    loaded = _joined(parts, stage.pause)
    lowered = loaded.seconds
    lower = lowered - down.seconds, lowered
    times = np.append(loaded.times, lowered + config.dwell)
    waypoints = np.vstack([loaded.waypoints, loaded.waypoints[-1]])
    path = GripPath(
        times=times,
        positions=waypoints[:, :3],
        rotations=np.array([quat_from_yaw(w[3]) for w in waypoints]),
        particle=grasp.particle,
        body=grasp.body,
        offset=grasp.offset,
        turn=grasp.turn,
        lower=lower if config.sheet_meets or not grasp.sheet else None,
    )
    above = np.array([place[0], place[1], hover, yaw])
    retreat = abs(hover - bottom) / config.unloaded_speed
    motion = Motion(np.append(times, times[-1] + retreat), np.vstack([waypoints, above]))
    return motion, path


def solve_joints(
    robot: Robot, motions: Sequence[Motion], postures: Sequence[np.ndarray]
) -> list[np.ndarray | None]:
    """Joint waypoints (K, dof) of every motion, solved in one batch; None: out of reach.

    Args:
        postures: joint positions (dof,) [rad] from which each motion sets out
    """
    if not motions:
        return []
    lengths = [len(m.waypoints) for m in motions]
    points = np.concatenate([m.waypoints for m in motions])
    result = robot.trajectory(points, lengths=lengths, seed=np.array(postures))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return [result.q[a:b] if result.reached[a:b].all() else None for a, b in pairwise(starts)]


def _straight(points: Sequence[np.ndarray], speed: float, config: PrimitiveConfig) -> Motion:
    """Waypoints along straight lines at `speed` [m/s], or slower where the turn takes longer."""
    times, waypoints = [0.0], [points[0]]
    for a, b in pairwise(points):
        distance = float(np.linalg.norm(b[:3] - a[:3]))
        turn = abs(float(b[3] - a[3]))
        seconds = max(distance / speed, turn / config.turn_speed)
        pieces = math.ceil(max(1.0, distance / config.spacing, turn / config.turn_spacing))
        for k in range(1, pieces + 1):
            times.append(times[-1] + seconds / pieces)
            waypoints.append(a + (b - a) * (k / pieces))
    return Motion(np.array(times), np.array(waypoints))


def _gentle(motion: Motion) -> Motion:
    """The same straight line in the same time, begun and ended at rest (smoothstep)."""
    u = np.linspace(0.0, 1.0, max(_GENTLE_PIECES, len(motion.times)))
    way = u * u * (3 - 2 * u)
    a, b = motion.waypoints[0], motion.waypoints[-1]
    return Motion(motion.seconds * u, a + (b - a) * way[:, None])


def _joined(motions: Sequence[Motion], pause: float) -> Motion:
    """One after the other, at rest for `pause` [s] between them."""
    times, waypoints = motions[0].times, motions[0].waypoints
    for motion in motions[1:]:
        if pause > 0:
            times = np.append(times, times[-1] + pause)
            waypoints = np.vstack([waypoints, waypoints[-1]])
        times = np.append(times, times[-1] + motion.times[1:])
        waypoints = np.vstack([waypoints, motion.waypoints[1:]])
    return Motion(times, waypoints)


def _half_turn(angle: float) -> float:
    """The same turn the short way round, in [-pi, pi) [rad]."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _sheet_vertex(
    x: float, y: float, sheet: Cloth | Bag, particle_q: np.ndarray
) -> tuple[float, int] | None:
    """Height [m] at which a descending tip comes near enough to a sheet, and the vertex it takes.

    A bead of a bag that is met soon after is taken instead: it is the firmer thing to hold.
    """
    first, points = sheet.particles.start, particle_q[sheet.particles.start : sheet.particles.stop]
    reach = sheet.config.grasp_reach
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    tops = points[:, 2] + np.sqrt(np.maximum(reach**2 - away**2, 0.0))
    tops[away > reach] = -np.inf
    i = int(np.argmax(tops))
    if not np.isfinite(tops[i]):
        return None
    if isinstance(sheet, Bag):
        beads = np.array(sheet.ring) - first
        bead = int(beads[np.argmax(tops[beads])])
        if tops[bead] > tops[i] - BEAD_FIRST:
            i = bead
    return float(points[i, 2]) + _thickness(sheet, i + first), first + i


def _thickness(sheet: Cloth | Bag, particle: int) -> float:
    """From the middle of a sheet to its surface at a vertex [m]."""
    if isinstance(sheet, Cloth):
        return sheet.config.radius
    beads = particle in sheet.ring
    return sheet.config.bead_radius if beads else sheet.config.shell_radius


def _box_top(x: float, y: float, box: Box, pose: np.ndarray) -> float | None:
    """Height at which a vertical line through x, y first meets a body, or None."""
    best: float | None = None
    back = quat_inverse(pose[3:])
    start = quat_rotate(back, np.array([x, y, 1.0]) - pose[:3])
    along = quat_rotate(back, np.array([0.0, 0.0, -1.0]))
    for part in box.config.parts:
        half = np.array(part.size) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            near = (np.array(part.offset) - half - start) / along
            far = (np.array(part.offset) + half - start) / along
        inside = np.abs(start - part.offset) <= half
        low = np.where(along == 0, np.where(inside, -np.inf, np.inf), np.minimum(near, far)).max()
        high = np.where(along == 0, np.where(inside, np.inf, -np.inf), np.maximum(near, far)).min()
        if low <= high and (best is None or 1.0 - low > best):
            best = 1.0 - float(low)
    return best
