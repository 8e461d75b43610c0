"""Nothing gets past `SafeRobot`, whatever it is told and whatever inverse kinematics answers."""

from __future__ import annotations

import numpy as np
from fixtures.safety_spy import ARM, HOME, SpyRobot, assert_within, joints_at, pose, solved_line
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware import RobotError
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import Q_MAX, Q_MIN
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.straight_line import StraightLine
from hardware.arm.table_plane import TablePlane
from warp_deform.errors import InputError

FLAT = SafetyLimits(table=TablePlane(0.0))
tables = st.builds(
    TablePlane, st.floats(-0.05, 0.1), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)
)
targets = st.builds(
    pose,
    st.floats(0.15, 0.75),
    st.floats(-0.45, 0.45),
    st.floats(-0.05, 0.7) | st.floats(0.0, 0.08),
    tilt=st.just(0.0) | st.floats(-0.6, 0.6),
)
speeds = st.sampled_from([0.05, 0.1]) | st.floats(-0.1, 0.3) | st.just(float("nan"))
forces = st.sampled_from([None, 8.0]) | st.floats(-1.0, 20.0) | st.just(float("nan"))
answers = st.sampled_from(["honest", "chord", "far", "noise", "nan", "still", "limits"])
steps = st.tuples(
    st.sampled_from(["line", "line", "line", "joints", "joints", "home", "check"]),
    targets,
    speeds,
    forces,
    answers,
    st.integers(0, 2**31),
)
TOLD = (RobotError, InputError)


class LyingSolver:
    """Answers as it is told to, honestly or not."""

    def __init__(self) -> None:
        self.kind, self.rng = "honest", np.random.default_rng(0)

    def __call__(self, arm: object, q: np.ndarray, T: np.ndarray, *, speed: float) -> StraightLine:
        rng = self.rng
        if self.kind == "honest":
            return solved_line(ARM, q, T, speed=speed)
        points = {
            "chord": lambda: np.linspace(q, q + rng.uniform(-0.4, 0.4, 7), 4)[1:],
            "far": lambda: rng.uniform(Q_MIN, Q_MAX, (2, 7)),
            "noise": lambda: q + np.cumsum(rng.normal(0.0, 0.05, (5, 7)), axis=0),
            "nan": lambda: np.where(rng.random((3, 7)) < 0.1, np.nan, q),
            "still": lambda: np.array([q]),
            "limits": lambda: np.array([q, np.where(rng.random(7) < 0.5, Q_MIN, Q_MAX)]),
        }[self.kind]()
        return StraightLine(points, 0.1)


def tell(robot: SafeRobot, solver: LyingSolver, step: tuple) -> None:
    """Give one command; what it answers is of no concern here."""
    kind, target, speed, force, answer, seed = step
    solver.kind, solver.rng = answer, np.random.default_rng(seed)
    q = robot.state().q
    try:
        if kind == "line":
            robot.move_linear(target, speed=speed, stop_force_N=force)
        elif kind == "check":
            robot.check_lines([(target, speed, force), (pose(), 0.05, 8.0)])
        elif kind == "home":
            robot.home()
        else:
            count = 1 + seed % 4
            scale = (0.05, 0.2, 0.6)[seed % 3]
            turns = solver.rng.uniform(-scale, scale, (count, 7))
            robot.move_joints(q + np.cumsum(turns, axis=0), speed=speed)
    except TOLD as refused:
        assert "\n" not in str(refused)


@settings(derandomize=True, deadline=None, max_examples=1000)
@given(table=tables, start=st.integers(0, 15), miss=st.sampled_from([0.0, 0.002]), step=steps)
def test_no_command_gets_past_the_limits(
    table: TablePlane, start: int, miss: float, step: tuple
) -> None:
    limits = SafetyLimits(table=table)
    solver = LyingSolver()
    spy = SpyRobot(q=STARTS[start].copy(), miss=miss)
    robot = SafeRobot(spy, limits, line_solver=solver)
    kind = "chord" if step[4] == "honest" else step[4]  # honest lines are solved below: they cost
    tell(robot, solver, (*step[:4], kind, step[5]))
    assert_within(limits, spy)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(table=tables, miss=st.sampled_from([0.0, 0.001]), told=st.lists(steps, max_size=6))
def test_no_sequence_of_commands_gets_past_the_limits(
    table: TablePlane, miss: float, told: list[tuple]
) -> None:
    limits = SafetyLimits(table=table)
    solver = LyingSolver()
    spy = SpyRobot(miss=miss, contact_at=table.height_m + 0.012)
    robot = SafeRobot(spy, limits, line_solver=solver)
    for step in told:
        tell(robot, solver, (*step[:4], "honest", step[5]))
    assert_within(limits, spy)


unit = st.floats(-1.0, 1.0)
short = st.fixed_dictionaries(
    {
        "start": st.integers(0, 15),
        "height": st.floats(0.007, 0.09),
        "slope": st.tuples(unit, unit),
        "shift": st.tuples(unit, unit, unit),
        "tilt": st.just(0.0) | unit,
        "speed": st.sampled_from([0.05, 0.05, 0.05, 0.06, 0.1, 0.11]),
        "force": st.sampled_from([None, 8.0, 8.0, 8.0, 9.0]),
        "miss": st.sampled_from([0.0, 0.0, 1e-3]),
    }
)


def near_the_table(
    start: int, height: float, slope: tuple[float, float]
) -> tuple[SafetyLimits, SpyRobot, SafeRobot]:
    """A robot whose TCP is `height` above a table that leans by `slope` times its greatest."""
    q, slopes = STARTS[start], 0.05 * np.array(slope)
    tcp = ARM.pose(q)[:3, 3]
    limits = SafetyLimits(table=TablePlane(tcp[2] - height - float(slopes @ tcp[:2]), *slopes))
    spy = SpyRobot(q=q.copy())
    # The home pose may be too high above such a table, or too low: it is not used here.
    return (
        limits,
        spy,
        SafeRobot(spy, limits, home_q=q if height >= 0.009 else HOME, line_solver=solved_line),
    )


def short_line(case: dict) -> tuple[SafetyLimits, SpyRobot]:
    """Command a line of some centimetres near the table."""
    try:
        limits, spy, robot = near_the_table(case["start"], case["height"], case["slope"])
    except InputError:
        return FLAT, SpyRobot()
    spy.miss = case["miss"]
    target = ARM.pose(spy.q)
    target[:3, :3] = pose(tilt=0.15 * case["tilt"])[:3, :3]
    target[:3, 3] += 0.03 * np.array(case["shift"])
    try:
        robot.move_linear(target, speed=case["speed"], stop_force_N=case["force"])
    except TOLD:
        assert spy.miss or not spy.lines
    return limits, spy


def short_joint_path(
    start: int, height: float, slope: tuple[float, float], scale: float, turns: np.ndarray
) -> tuple[SafetyLimits, SpyRobot]:
    """Command waypoints whose steps are `turns` (n, 7) times `scale` [rad], near the table."""
    try:
        limits, spy, robot = near_the_table(start, height, slope)
    except InputError:
        return FLAT, SpyRobot()
    try:
        robot.move_joints(spy.q + np.cumsum(scale * turns, axis=0), speed=0.05)
    except TOLD:
        assert not spy.joints
    return limits, spy


@settings(derandomize=True, deadline=None, max_examples=700)
@given(case=short)
def test_no_short_line_gets_past_the_limits(case: dict) -> None:
    """Half a hand above the table, where the floor and the rules of a descent bind."""
    limits, spy = short_line(case)
    assert_within(limits, spy)


@settings(derandomize=True, deadline=None, max_examples=1500)
@given(
    start=st.integers(0, 15),
    height=st.floats(0.045, 0.06) | st.floats(0.06, 0.3),
    slope=st.tuples(unit, unit),
    seed=st.integers(0, 2**31),
    scale=st.sampled_from([0.01, 0.05, 0.2, 0.6]),
)
def test_no_joint_path_gets_past_the_limits(
    start: int, height: float, slope: tuple[float, float], seed: int, scale: float
) -> None:
    """Waypoints near the limits, where many paths are refused and some are not."""
    turns = np.random.default_rng(seed).uniform(-1.0, 1.0, (1 + seed % 4, 7))
    limits, spy = short_joint_path(start, height, slope, scale, turns)
    assert_within(limits, spy)


def starts() -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    corners = rng.uniform([0.34, -0.32, 0.06], [0.65, 0.32, 0.5], (15, 3))
    return [HOME, *(joints_at(pose(*corner)) for corner in corners)]


STARTS = starts()


def test_the_properties_are_not_empty() -> None:
    """A good part of what the properties draw is let through, or they would say nothing."""
    rng = np.random.default_rng(0)
    lines = joints = 0
    for i in range(60):
        start, slope = int(rng.integers(16)), tuple(rng.uniform(-1, 1, 2))
        shift, height = tuple(rng.uniform(-1, 1, 3)), float(rng.uniform(0.007, 0.09))
        case = {"start": start, "height": height, "slope": slope, "shift": shift, "tilt": 0.0}
        lines += len(short_line({**case, "speed": 0.05, "force": 8.0, "miss": 0.0})[1].lines)
        turns = rng.uniform(-1.0, 1.0, (2, 7))
        _, spy = short_joint_path(start, height + 0.1, slope, (0.01, 0.05)[i % 2], turns)
        joints += len(spy.joints)
    assert lines > 15 and joints > 15
