"""Pick and place with a parallel jaw, in many worlds side by side.

Descend with open fingers until contact, close, lift, carry, lower until contact, open, go up. What
the fingers take, push, press or miss is `jaw.Jaw`'s affair. The hand's path is a script that is
told what the hand feels; the worlds run in short launches between its commands.

Source: Seita et al., ICRA 2021, section on physical experiments, for the primitive, the openings
and heights.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..rollout.rollouts import Frames, Rollout
from ..xpbd.config import FOREVER
from ..xpbd.guards import WatchValues
from .jaw import Jaw, JawConfig, JawContact
from .primitive import Motion, Outcome

if TYPE_CHECKING:
    from ..xpbd.fused_xpbd import FusedXPBD

__all__ = ["JawActionConfig", "JawCommand", "hand_pose", "jaw_motion", "jaw_script", "run_scripts"]

_FRAMES = 40
"""Waypoints of a motion that is drawn, at most."""


@dataclass(frozen=True, kw_only=True)
class JawActionConfig:
    """Heights of the TCP above the ground [m], openings [m], speeds [m/s], and what goes wrong."""

    fingers: JawConfig = field(default_factory=lambda: JawConfig(slip=0.02))
    """The fingers; a few grips slip."""
    start_m: float = 0.03
    """From where on a descent is simulated: above everything that lies there."""
    hover_m: float = 0.07
    """Before picking and after placing."""
    grasp_m: float = 0.010
    """When taking hold: the fingertips are just above the foam."""
    short_lift_m: float = 0.04
    """While carrying not farther than `short_distance_m`; else the action's lift."""
    short_distance_m: float = 0.075
    """What counts as short: 40 pixels."""
    place_m: float = 0.015
    """When letting go."""
    contact_slack_m: float = 0.010
    """How much higher than planned a descent may meet something and still count as arrived."""
    back_off_m: float = 0.002
    """How far to rise after a contact before the fingers move."""
    open_width_m: float = 0.035
    """Opening on the way down."""
    release_width_m: float = 0.030
    """Opening that lets go."""
    gripper_speed: float = 0.05
    """Of the opening."""
    descent_speed: float = 0.05
    """Down, where something may be met."""
    speed: float = 0.10
    """Everywhere else."""
    turn_speed: float = 0.5
    """[rad/s]"""
    stop_force_N: float = 8.0
    """Force at which a descent has met something [N]."""
    tick: float = 0.004
    """Interval between two commands to the hand [s]."""
    position_noise: float = 0.001
    """Standard deviation of where the hand goes, x and y: calibration and the arm."""
    yaw_noise: float = 0.05
    """Standard deviation of its turn [rad]: the tangent is measured in a mask."""

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self) if each.name != "fingers"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise InputError(f"JawActionConfig.{name} must be 0 or more, got {value}")

    def disturbed(self, action: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Where the hand really goes instead of where `action` (7,) says."""
        noise = rng.normal(size=6) * np.tile([self.position_noise] * 2 + [self.yaw_noise], 2)
        return np.asarray(action + np.append(noise, 0.0))

    def lift(self, action: np.ndarray) -> float:
        """Height of the carry [m]: short ways are low."""
        short = math.dist(action[:2], action[3:5]) <= self.short_distance_m
        return min(float(action[6]), self.short_lift_m) if short else float(action[6])


@dataclass(frozen=True, eq=False)
class JawCommand:
    """Where the hand is to be after the next tick: x, y, z [m], yaw [rad]; and its fingers."""

    tip: np.ndarray
    opening: float
    closing: bool


Script = Generator[JawCommand, JawContact, Outcome]


def hand_pose(tip: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a hand that points down at `tip` (4,): x, y, z [m], yaw [rad]."""
    c, s = math.cos(tip[3]), math.sin(tip[3])
    x, y, z = tip[:3]
    return np.array([[c, s, 0, x], [s, -c, 0, y], [0, 0, -1, z], [0, 0, 0, 1.0]])


def _tips(action: np.ndarray, config: JawActionConfig) -> dict[str, np.ndarray]:
    """Way-points by name; the hand turns the short way from pick yaw to place yaw."""
    lift, yaw = config.lift(action), float(action[2])
    turned = yaw + math.remainder(float(action[5]) - yaw, 2 * math.pi)
    pick, place = action[:2], action[3:5]
    return {
        "hover": np.array([*pick, config.hover_m, yaw]),
        "start": np.array([*pick, config.start_m, yaw]),
        "grasp": np.array([*pick, config.grasp_m, yaw]),
        "lift": np.array([*pick, lift, yaw]),
        "carry": np.array([*place, lift, turned]),
        "place": np.array([*place, config.place_m, turned]),
        "retreat": np.array([*place, config.hover_m, turned]),
    }


def jaw_motion(tip: np.ndarray, action: np.ndarray, config: JawActionConfig) -> Motion:
    """The whole path of the hand from `tip` (4,), as planned: for reach, and for drawing."""
    times, points = [0.0], [np.asarray(tip, dtype=float)]
    for name, point in _tips(action, config).items():
        slow = name in ("grasp", "place")
        speed = config.descent_speed if slow else config.speed
        distance = float(np.linalg.norm(point[:3] - points[-1][:3]))
        turn = abs(float(point[3] - points[-1][3]))
        pieces = max(1, math.ceil(distance / 0.1), math.ceil(turn / 0.5))
        seconds = max(distance / speed, turn / config.turn_speed)
        begin = points[-1]
        for k in range(1, pieces + 1):
            times.append(times[-1] + seconds / pieces)
            points.append(begin + (point - begin) * (k / pieces))
    return Motion(np.array(times), np.array(points))


def jaw_script(jaw: Jaw, action: np.ndarray, config: JawActionConfig) -> Script:
    """Commands of one pick and place; each is answered with what the hand feels."""
    tips = _tips(action, config)
    opening = config.open_width_m
    tip, felt = yield from _down(tips["start"], tips["grasp"], opening, config)
    if felt.force > config.stop_force_N:
        if tip[2] - config.grasp_m > config.contact_slack_m:
            yield from _moved(tip, tips["hover"], opening, config)
            return Outcome.MISSED
        above = tip.copy()
        above[2] = max(tip[2] + config.back_off_m, config.grasp_m)
        yield from _moved(tip, above, opening, config)
        tip = above
    while opening > 0.0 and not len(jaw.held):
        opening = max(opening - config.gripper_speed * config.tick, felt.width)
        felt = yield JawCommand(tip, opening, True)
        if felt.width > 0.0 and opening <= felt.width and not len(jaw.held):
            break  # squeezed out on the last stretch
    if not len(jaw.held):
        yield from _moved(tip, tips["hover"], config.open_width_m, config)
        return Outcome.MISSED
    for name, speed in (("lift", config.speed), ("carry", config.speed)):
        yield from _moved(tip, tips[name], opening, config, speed=speed, closing=True)
        tip = tips[name]
        if not len(jaw.held):
            yield from _moved(tip, tips[name], config.open_width_m, config)
            return Outcome.MISSED
    tip, _ = yield from _down(tips["carry"], tips["place"], opening, config, closing=True)
    while opening < config.release_width_m:
        opening = min(opening + config.gripper_speed * config.tick, config.release_width_m)
        yield JawCommand(tip, opening, False)
    yield from _moved(tip, tips["retreat"], opening, config)
    return Outcome.PLACED


def _line(
    start: np.ndarray, end: np.ndarray, speed: float, config: JawActionConfig
) -> list[np.ndarray]:
    """Tips (4,) a tick apart along a straight line, without the start."""
    distance = float(np.linalg.norm(end[:3] - start[:3]))
    seconds = max(distance / speed, abs(float(end[3] - start[3])) / config.turn_speed)
    count = max(1, math.ceil(seconds / config.tick))
    return [start + (end - start) * (k / count) for k in range(1, count + 1)]


def _down(
    start: np.ndarray,
    end: np.ndarray,
    opening: float,
    config: JawActionConfig,
    *,
    closing: bool = False,
) -> Generator[JawCommand, JawContact, tuple[np.ndarray, JawContact]]:
    """Go down until something is met; returns where, and what was felt there."""
    tip, felt = start, JawContact(0.0, 0.0)
    for point in _line(start, end, config.descent_speed, config):
        tip = point
        felt = yield JawCommand(tip, opening, closing)
        if felt.force > config.stop_force_N:
            break
    return tip, felt


def _moved(
    start: np.ndarray,
    end: np.ndarray,
    opening: float,
    config: JawActionConfig,
    *,
    speed: float | None = None,
    closing: bool = False,
) -> Generator[JawCommand, JawContact, None]:
    for tip in _line(start, end, speed or config.speed, config):
        yield JawCommand(tip, opening, closing)


def run_scripts(
    solver: FusedXPBD,
    jaws: Mapping[int, Jaw],
    scripts: Mapping[int, Script],
    config: JawActionConfig,
    *,
    record: float = 0.0,
) -> dict[int, tuple[Outcome, Rollout]]:
    """Run one script in every named world until all have ended; ended worlds keep their state.

    Args:
        record: interval of recorded frames [s]; 0 records nothing
    """
    steps = max(1, round(config.tick / solver.config.dt))
    tick = steps * solver.config.dt
    every = max(1, round(record / tick)) if record else 0
    solver.data.clear_grips()
    solver.set_duration(FOREVER, FOREVER)
    running = dict(scripts)
    commands = {w: next(script) for w, script in running.items()}
    seen: dict[int, list[WatchValues]] = {w: [] for w in scripts}
    frames: dict[int, list[np.ndarray]] = {w: [] for w in scripts}
    ended: dict[int, tuple[Outcome, Rollout]] = {}
    solver.activate(np.array(sorted(running), int))
    while running:
        felt = {
            w: jaws[w].move(hand_pose(c.tip), c.opening, closing=c.closing, steps=steps)
            for w, c in commands.items()
        }
        for w in running if every else ():
            if len(seen[w]) % every == 0:
                frames[w].append(solver.particle_q(w).astype(np.float32))
        values = solver.run(steps)
        finished = []
        for w, script in running.items():
            seen[w].append(values[w])
            try:
                commands[w] = script.send(felt[w])
            except StopIteration as stop:
                finished.append(w)
                recorded = None
                if every:
                    times = np.arange(len(frames[w])) * every * tick
                    bodies = np.zeros((len(times), 0, 7), np.float32)
                    recorded = Frames(times, np.array(frames[w]), bodies)
                ended[w] = (
                    stop.value,
                    Rollout(len(seen[w]) * tick, _worst(seen[w]), False, recorded),
                )
        if finished:
            for w in finished:
                del running[w], commands[w]
            solver.activate(np.array(sorted(running), int))
    return ended


def _worst(values: list[WatchValues]) -> WatchValues:
    """The guards' values over several launches."""
    return replace(
        values[0],
        steps=sum(v.steps for v in values),
        nonfinite=any(v.nonfinite for v in values),
        stretch=max(v.stretch for v in values),
        depth=max(v.depth for v in values),
        box_depth=max(v.box_depth for v in values),
        box_overlap=max(v.box_overlap for v in values),
        clamped=sum(v.clamped for v in values),
        overflow=max(v.overflow for v in values),
    )
