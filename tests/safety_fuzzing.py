"""Random and adversarial commands through `SafeRobot`, and a judge of what is executed.

The simulated robot executes what gets through, and every step of its joints is judged by forward
kinematics that are not the product's (`panda_urdf`). Judged are the
TCP's speed and its speed downwards, workspace, floor, ceiling, tilt, the joints' margins and
speeds, descents without a stop force below `contact_height_m`, the fingers' force, malformed
arguments (a typed error, and nothing moved), and that nothing moves after `stop()` until
`recover()`.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from panda_urdf import about_z, poses

from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q
from hardware.arm.robot import RobotError
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.emulator.world import Contact, Hand, TableWorld
from hardware.twin.robot import SimRobot, SimRobotConfig
from warp_deform.errors import InputError

JOINT_LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # [rad]
JOINT_HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # [rad]
JOINT_SPEED = np.array([2.175] * 4 + [2.61] * 3)  # [rad/s]
PER_ROBOT = 25  # commands to one robot before the next
# What a limit may be missed by: the sampling of the path [m, rad], and rounding.
ON_PATH, ROUNDING = 1.5e-4, 1e-7
LEVEL = 1e-3  # [m]: an arm may sag by so much in all without a stop force
JUNK: tuple[Any, ...] = (
    0, 0.0, -1.0, float("nan"), float("inf"), 1e-300, -1e-300, True, None, "0.05", b"1", 1j, [0.05],
    np.array([0.05]), np.array([0.05, 0.05]), {}, object, np.nan, np.complex128(0.05 + 1e-9j),
)  # fmt: skip


class Recorder(TableWorld):
    """A table, and the joints' positions at every step."""

    def __init__(self) -> None:
        super().__init__()
        self.robot: SimRobot | None = None
        self.q: list[np.ndarray] = []
        self.forces: list[float] = []

    def step(self, hand: Hand) -> Contact:
        if self.robot is not None:
            self.q.append(self.robot.state().q)
        return super().step(hand)


@dataclass
class Tally:
    """What happened.

    Attributes:
        commands, moved, refused: how many
        findings: limits that were broken, by name, how often
        worst: greatest share of each speed limit that was reached
        examples: the first commands of each finding
    """

    commands: int = 0
    moved: int = 0
    refused: int = 0
    findings: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)
    examples: dict[str, str] = field(default_factory=dict)

    def find(self, name: str, command: str, value: float = np.nan) -> None:
        """Note a broken limit."""
        self.findings[name] += 1
        self.examples.setdefault(name, f"{command}: {value:.4g}")

    def reach(self, name: str, share: float) -> None:
        """Note how much of a limit was used."""
        self.worst[name] = max(self.worst.get(name, 0.0), float(share))

    def record(self) -> dict[str, Any]:
        """Return it as JSON types."""
        return {
            "commands": self.commands,
            "moved": self.moved,
            "refused": self.refused,
            "findings": dict(sorted(self.findings.items())),
            "greatest_share_of_limit": {k: round(v, 4) for k, v in sorted(self.worst.items())},
            "examples": self.examples,
        }


class Fuzz:
    """One robot and the commands it gets."""

    def __init__(self, rng: np.random.Generator, tally: Tally, dt: float) -> None:
        self.rng, self.tally, self.dt = rng, tally, dt
        slopes = rng.choice([0.0, 1.0]) * rng.uniform(-0.03, 0.03, 2)
        table = TablePlane(float(rng.uniform(-0.02, 0.02)), *map(float, slopes))
        speed = float(rng.choice([0.05, 0.05, 0.1, 0.2]))
        self.limits = SafetyLimits(table=table, max_joint_speed=speed)
        self.world = Recorder()
        self.sim = SimRobot(self.world, SimRobotConfig(dt=dt))
        self.world.robot = self.sim
        self.robot = SafeRobot(self.sim, self.limits)
        self.stopped = False
        # Heights count up to `contact_height_m`; the highest since the last motion with a stop.
        self.high = self.limits.contact_height_m

    def go(self, commands: int) -> None:
        """Give so many commands."""
        kinds: list[tuple[Callable[[], None], float]] = [
            (self.line, 0.28), (self.creep, 0.07), (self.joints, 0.22), (self.far, 0.10),
            (self.home, 0.06), (self.malformed, 0.15), (self.fingers, 0.05), (self.stop, 0.04),
            (self.assign, 0.03),
        ]  # fmt: skip
        chances = np.array([chance for _, chance in kinds])
        until = self.tally.commands + commands
        while self.tally.commands < until:
            kinds[self.rng.choice(len(kinds), p=chances / chances.sum())][0]()

    # Commands.

    def line(self, target: np.ndarray | None = None, force: Any = "any") -> None:
        """A straight line to anywhere, at any speed."""
        rng = self.rng
        target = self.pose() if target is None else target
        speed = float(rng.choice([0.05, 0.1, 0.0999, 0.02, 0.3, 0.12, -0.1]))
        if force == "any":
            force = (None, 8.0, 2.0, 12.0, -1.0)[int(rng.integers(5))]
        self.give(
            f"move_linear speed {speed:g} stop_force_N {force}",
            lambda: self.robot.move_linear(target, speed=speed, stop_force_N=force),
            forced=force is not None,
        )

    def creep(self) -> None:
        """Many small steps downwards, aside or leaning, each below every threshold."""
        rng = self.rng
        start = self.pose(z=(0.012, 0.08), tilt=0.0)
        start[2, 3] += float(self.limits.table.z(start[:2, 3]))
        self.line(start, 8.0)
        step = float(rng.choice([2e-4, 5e-4, 9.5e-4, 1.5e-3]))
        for _ in range(int(rng.integers(4, 12))):
            target = self.sim.state().base_T_tcp
            target[2, 3] -= step
            target[:2, 3] += rng.uniform(-1, 1, 2) * float(rng.choice([0.0, 0.0, 2e-3]))
            self.line(orthonormal(target), None)

    def joints(self) -> None:
        """Way-points at random turns from here, sometimes to and fro."""
        rng = self.rng
        count = int(rng.integers(1, 6))
        scale = float(rng.choice([0.0009, 0.02, 0.1, 0.3, 0.6]))
        turns = scale * rng.uniform(-1, 1, (count, 7)) * (rng.random((count, 7)) < 0.6)
        if rng.random() < 0.2:
            turns = turns[:1] * np.where(np.arange(count) % 2, -0.95, 1.0)[:, None]
        self.way(self.sim.state().q + np.cumsum(turns, axis=0))

    def far(self) -> None:
        """In joint space to home turned by a lot, in a few steps: the fastest way there is."""
        rng, q = self.rng, self.sim.state().q
        goal = np.array(HOME_Q)
        goal[0] += rng.uniform(-0.6, 0.6)
        goal[[1, 3, 5]] += rng.uniform(-0.1, 0.45) * np.array([1.0, 0.3, 0.7])
        goal[6] += rng.uniform(-1.0, 1.0)
        count = max(int(np.ceil(np.abs(goal - q).max() / 0.45)), 1)
        self.way(q + np.arange(1, count + 1)[:, None] / count * (goal - q))

    def way(self, points: np.ndarray) -> None:
        speed = float(self.rng.choice([self.limits.max_joint_speed, 0.05, 0.01, 0.2, 0.5]))
        self.give(
            f"move_joints {len(points)} points speed {speed:g}",
            lambda: self.robot.move_joints(points, speed=speed),
            share=speed,
        )

    def home(self) -> None:
        """Home, at allowed and other speeds."""
        speed = (None, None, 0.05, 0.0, -0.1, 0.3)[int(self.rng.integers(6))]
        wrong = speed is not None and not 0.0 < speed <= self.limits.max_joint_speed
        self.give(f"home speed {speed}", lambda: self.robot.home(speed=speed), wrong=wrong)

    def malformed(self) -> None:
        """One argument that is no number, no pose, or none that can be meant."""
        rng, robot = self.rng, self.robot
        junk = JUNK[int(rng.integers(len(JUNK)))]
        here = self.sim.state()
        target, q = orthonormal(here.base_T_tcp), here.q
        target[2, 3] = min(target[2, 3] + 0.01, self.limits.max_z_m)
        none = junk is None
        bent: list[Any] = [target + 1e-3 * rng.normal(size=(4, 4)), target * 1j, target[:3], junk,
                           -target, target.astype(str), np.diag([1.0, 1, 1, 0]) @ target,
                           np.where(np.eye(4), np.nan, target)]  # fmt: skip
        far: list[Any] = [q[:6], q * np.nan, q + 1j, [*q[:6], None], [list(q), [1.0]], junk,
                          q.astype(str), np.zeros((0, 7)), np.zeros((1, 1, 7)), q > 0]  # fmt: skip
        pick, points = bent[int(rng.integers(len(bent)))], far[int(rng.integers(len(far)))]
        calls: list[tuple[str, bool, Callable[[], Any]]] = [
            ("move_linear pose", True, lambda: robot.move_linear(pick, speed=0.05)),
            ("move_linear speed", True, lambda: robot.move_linear(target, speed=junk)),
            ("move_linear force", not none,
             lambda: robot.move_linear(target, speed=0.05, stop_force_N=junk)),
            ("move_joints q", True, lambda: robot.move_joints(points, speed=0.05)),
            ("move_joints speed", True, lambda: robot.move_joints(q, speed=junk)),
            ("home speed", not none, lambda: robot.home(speed=junk)),
            ("open_gripper", True, lambda: robot.open_gripper(junk)),
            ("grasp width", True, lambda: robot.grasp(width_m=junk, force_N=5.0)),
            ("grasp force", True, lambda: robot.grasp(width_m=0.01, force_N=junk)),
            ("check_lines", True, lambda: robot.check_lines([(target, junk, None)])),
        ]  # fmt: skip
        name, wrong, call = calls[int(rng.integers(len(calls)))]
        self.give(f"{name} {junk!r}", call, wrong=wrong)

    def fingers(self) -> None:
        """Openings and forces."""
        width, force = float(self.rng.uniform(-0.01, 0.1)), float(self.rng.uniform(-5.0, 40.0))
        if self.rng.random() < 0.5:
            self.give("open_gripper", lambda: self.robot.open_gripper(width),
                      wrong=not 0.0 < width <= 0.08)  # fmt: skip
        else:
            fine = 0.0 < width <= 0.08 and 0.0 < force <= self.limits.max_grasp_force_N
            self.give("grasp", lambda: self.robot.grasp(width_m=width, force_N=force),
                      wrong=not fine)  # fmt: skip

    def stop(self) -> None:
        """A stop, commands that have to be refused, and a recovery."""
        self.robot.stop()
        self.stopped = True
        for command in (self.line, self.joints, self.home, self.fingers):
            command()
        self.robot.recover(confirmed=True)
        self.stopped = False

    def assign(self) -> None:
        """Other limits, put in place of those it was made with."""
        self.tally.commands += 1
        for name, value in (("limits", SafetyLimits(table=TablePlane(-1.0))), ("home_q", None)):
            with contextlib.suppress(AttributeError):
                setattr(self.robot, name, value)
        if self.robot.limits is not self.limits:
            self.tally.find("limits reassigned", "robot.limits = ...")
            self.robot.limits = self.limits  # type: ignore[misc]
        self.tally.refused += 1

    def pose(self, *, z: tuple[float, float] = (0.0, 0.62), tilt: float = 0.6) -> np.ndarray:
        """A hand that mostly points down, mostly within the workspace."""
        rng = self.rng
        lean = tilt * rng.uniform(-1, 1) * (rng.random() < 0.3)
        yaw, about = rng.uniform(-0.8, 0.8), rng.uniform(-np.pi, np.pi)
        T = np.eye(4)
        turn = about_z(np.array([about]))[0][:3, :3]
        c, s = np.cos(lean), np.sin(lean)
        R = turn @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ turn.T
        T[:3, :3] = R @ about_z(np.array([yaw]))[0][:3, :3] @ np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = rng.uniform(0.29, 0.68), rng.uniform(-0.34, 0.34), rng.uniform(*z)
        return T

    # Judging.

    def give(
        self,
        name: str,
        call: Callable[[], Any],
        *,
        forced: bool = False,
        wrong: bool = False,
        share: float = np.inf,
    ) -> None:
        """Give a command and judge what was executed."""
        tally, world = self.tally, self.world
        before = self.sim.state()
        world.q = [before.q]
        tally.commands += 1
        refused = False
        try:
            call()
        except (RobotError, InputError) as error:
            refused = True
            if "\n" in str(error):
                tally.find("message of several lines", name)
        except Exception as error:
            refused = True
            tally.find(f"untyped {type(error).__name__}", name)
        after = self.sim.state()
        moved = bool(np.ptp(np.array(world.q), axis=0).max() > 0.0)
        changed = moved or bool(np.any(after.gripper_width_m != before.gripper_width_m))
        tally.refused += refused
        tally.moved += changed
        if wrong and changed:
            tally.find("malformed argument moved something", name)
        elif wrong and not refused and not name.startswith("move_joints q"):
            tally.find("malformed argument accepted", name)
        if self.stopped and changed:
            tally.find("moved after stop()", name)
        if moved:
            self.judge(name, np.array(world.q), forced=forced, share=share)

    def judge(self, name: str, q: np.ndarray, *, forced: bool, share: float) -> None:
        """Every written limit on the executed joints (N, 7), `dt` apart."""
        limits, tally = self.limits, self.tally
        T = poses(q)
        velocity = np.diff(T[:, :3, 3], axis=0) / self.dt
        for limit, values, high in (
            ("TCP speed", np.linalg.norm(velocity, axis=1), limits.max_speed),
            ("TCP speed downwards", -velocity[:, 2], limits.max_descent_speed),
        ):
            tally.reach(limit, values.max() / high)
            if values.max() > high * (1.0 + ROUNDING):
                tally.find(limit, name, values.max())
        if not name.startswith("move_linear"):
            speed = (np.abs(np.diff(q, axis=0)) / self.dt / JOINT_SPEED).max()
            allowed = limits.max_joint_speed
            if name.startswith("home"):  # its way up is a straight line
                allowed = np.inf if self.high < limits.contact_height_m else allowed
            tally.reach("joint speed", 0.0 if allowed == np.inf else speed / allowed)
            if speed > min(allowed, share) * (1.0 + 1e-6):
                tally.find("joint speed", name, speed)
        x, y, z = T[:, :3, 3].T
        height = z - (limits.table.height_m + limits.table.slope_x * x + limits.table.slope_y * y)
        lean = np.arccos(np.clip(-T[:, 2, 2], -1.0, 1.0))
        margin, slack = limits.margin_m, limits.joint_margin * (JOINT_HIGH - JOINT_LOW)
        for limit, beyond in (
            ("workspace", np.max([limits.x[0] - margin - x, x - limits.x[1] - margin,
                                  limits.y[0] - margin - y, y - limits.y[1] - margin], axis=0)),
            ("ceiling", z - limits.max_z_m),
            ("floor", limits.min_tcp_height_m - height),
            ("tilt", lean - limits.max_tilt_rad),
            ("joint margin", np.max([JOINT_LOW + slack - q, q - JOINT_HIGH + slack], axis=(0, 2))),
        ):  # fmt: skip
            if beyond.max() > max(float(beyond[0]), 0.0) + ON_PATH:
                tally.find(limit, name, beyond.max())
        self.judge_descent(name, height, forced=forced)

    def judge_descent(self, name: str, height: np.ndarray, *, forced: bool) -> None:
        """Below `contact_height_m` nothing sinks by more than `LEVEL` in all without a stop."""
        low = np.minimum(height, self.limits.contact_height_m)
        if forced:  # what it sank is allowed, and nothing else
            self.high = float(max(self.high - max(low[0] - low[-1], 0.0), low[-1]))
            return
        top = np.maximum.accumulate(np.maximum(low, self.high))
        sunk = float((top - low).max())
        if sunk > LEVEL + ON_PATH:
            self.tally.find("descent without a stop force", name, sunk)
        self.high = float(top[-1])


def orthonormal(T: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) with its rotation made exact."""
    u, _, v = np.linalg.svd(T[:3, :3])
    exact = T.copy()
    exact[:3, :3] = u @ v
    return exact


def fuzz(commands: int, *, seed: int, dt: float = 2e-3) -> Tally:
    """Return what became of so many commands; the same for the same seed."""
    tally, robots = Tally(), 0
    while tally.commands < commands:
        rng = np.random.default_rng([seed, robots])
        Fuzz(rng, tally, dt).go(min(PER_ROBOT, commands - tally.commands))
        robots += 1
    return tally
