"""The pick-and-place primitive: an action becomes way-points of the tip over simulated time.

Source: Seita et al., ICRA 2021, appendix on the action primitive. The tip goes above the pick
point, descends until it meets something, takes it, lifts it, carries it above the place point,
lowers it until it meets something, waits, lets go and retreats. Where the original moves joints a
fixed angle a control tick of wall time, the tip here follows straight lines in simulated time, with
IK way-points along them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ..objects.box import Box
from ..objects.cable import Cable
from ..rollout import GripPath

if TYPE_CHECKING:
    from .arm import Robot

__all__ = ["Grasp", "Motion", "Outcome", "PrimitiveConfig", "approach", "carry", "find_grasp",
           "solve_joints"]  # fmt: skip


class Outcome(StrEnum):
    """What became of an action."""

    PLACED = "placed"
    MISSED = "missed"
    """The descending tip met only the table."""
    UNREACHABLE = "unreachable"
    """The arm cannot reach a way-point tip-down; nothing was moved."""
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
    tip_radius: float = 0.001
    """Radius of the suction tip [m]."""
    spacing: float = 0.10
    """Largest distance between joint way-points along a straight line [m]."""
    turn_spacing: float = 0.5
    """Largest turn between them [rad]."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """What a descending tip met first: a particle or a body, with its pose in the tip's frame.

    height: of the tip at contact [m]; offset (3,) [m] and turn (4,) quat_xyzw as in `GripPath`
    """

    height: float
    offset: np.ndarray
    turn: np.ndarray
    particle: int | None = None
    body: int | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """A stretch of the tip's motion: way-points (K, 4) x, y, z [m], yaw [rad] at times (K,) [s]."""

    times: np.ndarray
    way_points: np.ndarray

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])


def find_grasp(
    xy_yaw: np.ndarray,
    objects: Sequence[Cable | Box],
    particle_q: np.ndarray,
    body_q: np.ndarray,
    config: PrimitiveConfig,
) -> Grasp | None:
    """What a tip that descends at x, y (with a yaw) meets first above the table, or None.

    Beads count with their visual radius: the paper's beads are 1 cm cubes, whose corners reach as
    far. particle_q (P, 3); body_q (B, 7).
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
        else:
            top = _box_top(x, y, item, body_q[item.body])
            if top is not None and (best is None or top > best[0]):
                best = top, None, item.body
    if best is None:
        return None
    height, particle, body = best
    tip = np.array([x, y, height])
    back = _yaw_quat(-yaw)
    if particle is not None:
        offset = _rotate(back, particle_q[particle] - tip)
        return Grasp(height, offset, _yaw_quat(0.0), particle=particle)
    assert body is not None
    com = next(o for o in objects if isinstance(o, Box) and o.body == body).config.inertia()[0]
    centre = body_q[body, :3] + _rotate(body_q[body, 3:], com)
    turn = _multiply(back, body_q[body, 3:])
    return Grasp(height, _rotate(back, centre - tip), turn, body=body)


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
    speed: float,
    floor: float,
    hover: float,
    config: PrimitiveConfig,
) -> tuple[Motion, GripPath]:
    """Lift, carry and lower what `grasp` holds, then wait; the path for the solver, and the tip's.

    floor: lowest height of the tip over the place point [m], where what is held rests on the table
    The retreat to `hover` follows the release and is in the motion only.
    """
    pick, place, lift = action[:3], action[3:6], float(action[6])
    yaw = pick[2] + _half_turn(place[2] - pick[2])
    bottom = min(floor, lift)
    points = [
        np.array([pick[0], pick[1], grasp.height, pick[2]]),
        np.array([pick[0], pick[1], lift, pick[2]]),
        np.array([place[0], place[1], lift, yaw]),
        np.array([place[0], place[1], bottom, yaw]),
    ]
    loaded = _straight(points, speed, config)
    lowered = loaded.seconds
    lower = _straight(points[:-1], speed, config).seconds, lowered
    times = np.append(loaded.times, lowered + config.dwell)
    way_points = np.vstack([loaded.way_points, loaded.way_points[-1]])
    path = GripPath(
        times=times,
        positions=way_points[:, :3],
        rotations=np.array([_yaw_quat(w[3]) for w in way_points]),
        particle=grasp.particle,
        body=grasp.body,
        offset=grasp.offset,
        turn=grasp.turn,
        lower=lower,
    )
    above = np.array([place[0], place[1], hover, yaw])
    retreat = abs(hover - bottom) / config.unloaded_speed
    motion = Motion(np.append(times, times[-1] + retreat), np.vstack([way_points, above]))
    return motion, path


def solve_joints(
    robot: Robot, motions: Sequence[Motion], postures: Sequence[np.ndarray]
) -> list[np.ndarray | None]:
    """Joint way-points (K, dof) of every motion, solved in one batch; None: out of reach.

    postures: joint positions (dof,) [rad] from which each motion sets out
    """
    if not motions:
        return []
    lengths = [len(m.way_points) for m in motions]
    points = np.concatenate([m.way_points for m in motions])
    result = robot.trajectory(points, lengths=lengths, seed=np.array(postures))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return [result.q[a:b] if result.reached[a:b].all() else None for a, b in pairwise(starts)]


def _straight(points: Sequence[np.ndarray], speed: float, config: PrimitiveConfig) -> Motion:
    """Way-points along straight lines at `speed` [m/s], or slower where the turn takes longer."""
    times, way_points = [0.0], [points[0]]
    for a, b in pairwise(points):
        distance = float(np.linalg.norm(b[:3] - a[:3]))
        turn = abs(float(b[3] - a[3]))
        seconds = max(distance / speed, turn / config.turn_speed)
        pieces = math.ceil(max(1.0, distance / config.spacing, turn / config.turn_spacing))
        for k in range(1, pieces + 1):
            times.append(times[-1] + seconds / pieces)
            way_points.append(a + (b - a) * (k / pieces))
    return Motion(np.array(times), np.array(way_points))


def _half_turn(angle: float) -> float:
    """The same turn the short way round, in [-pi, pi) [rad]."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _box_top(x: float, y: float, box: Box, pose: np.ndarray) -> float | None:
    """Height at which a vertical line through x, y first meets a body, or None."""
    best: float | None = None
    back = pose[3:] * [-1, -1, -1, 1]
    start = _rotate(back, np.array([x, y, 1.0]) - pose[:3])
    along = _rotate(back, np.array([0.0, 0.0, -1.0]))
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


def _yaw_quat(yaw: float) -> np.ndarray:
    return np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    twice = 2.0 * np.cross(quat[:3], vector)
    return vector + quat[3] * twice + np.cross(quat[:3], twice)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of two quaternions xyzw."""
    xyz = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.append(xyz, a[3] * b[3] - a[:3] @ b[:3])
