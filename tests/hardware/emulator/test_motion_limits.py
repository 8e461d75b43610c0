"""Velocity, acceleration and jerk of motions, how they end, and what goes on while packets miss."""

from __future__ import annotations

import shutil
import struct

import numpy as np
import pytest
from fixtures.emulator_client import min_jerk
from fixtures.fci_wire import DEVIATIONS

from hardware.arm.panda import HOME_Q
from hardware.emulator.arm import Arm
from hardware.emulator.model_library import model_library
from hardware.emulator.motion_limits import (
    Check,
    elbow_excess,
    excess_at_end,
    joint_excess,
    torque_excess,
    twist_excess,
)
from hardware.emulator.protocol import (
    ERRORS,
    ROBOT_COMMAND,
    ROBOT_STATE,
    ControllerMode,
    GeneratorMode,
    MoveStatus,
    Request,
    RobotCommand,
    RobotMode,
)
from hardware.emulator.robot import EmulatedRobot

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
HOME = np.array(HOME_Q)
DT = 1e-3
JOINT, CARTESIAN = "joint_motion_generator", "cartesian_motion_generator"
KINDS = ("velocity_limits_violation", "velocity_discontinuity", "acceleration_discontinuity")
# As published: velocity, acceleration, jerk.
JOINTS = (
    [2.175] * 4 + [2.61] * 3,
    [15, 7.5, 10, 12.5, 15, 20, 20],
    [7500, 3750, 5000, 6250, 7500, 10000, 10000],
)
TRANSLATION, ROTATION, ELBOW = (1.7, 13, 6500), (2.5, 25, 12500), (2.175, 10, 5000)


def names(check: Check, size: int, order: int, value: np.ndarray) -> tuple[str, ...]:
    """What a check says of a motion whose derivative number `order` alone is not zero."""
    derivatives = [np.zeros(size)] * 3
    derivatives[order] = value
    return check(*derivatives)


@pytest.mark.parametrize("order", range(3))
def test_each_derivative_has_its_limit_and_its_name(order: int) -> None:
    for joint in range(7):
        for sign in (-1.0, 1.0):
            at_limit = sign * JOINTS[order][joint] * np.eye(7)[joint]
            assert names(joint_excess, 7, order, at_limit) == ()
            assert names(joint_excess, 7, order, 1.0001 * at_limit) == (f"{JOINT}_{KINDS[order]}",)
    rng = np.random.default_rng(order)
    for first, limits in ((0, TRANSLATION), (3, ROTATION)):
        direction = rng.normal(size=3)
        at_limit = np.zeros(6)
        at_limit[first : first + 3] = limits[order] * direction / np.linalg.norm(direction)
        assert names(twist_excess, 6, order, at_limit) == ()
        assert names(twist_excess, 6, order, 1.0001 * at_limit) == (f"{CARTESIAN}_{KINDS[order]}",)
    elbow = np.array([ELBOW[order]])
    assert names(elbow_excess, 1, order, elbow) == ()
    assert names(elbow_excess, 1, order, -1.0001 * elbow) == (f"{CARTESIAN}_elbow_limit_violation",)


@pytest.mark.parametrize(("check", "size"), [(joint_excess, 7), (twist_excess, 6)])
def test_numbers_that_are_none_are_too_much(check: Check, size: int) -> None:
    for value in (np.nan, np.inf, -np.inf):
        for order in range(3):
            assert len(names(check, size, order, value * np.ones(size))) == 1


def test_every_name_is_the_vendors() -> None:
    much = np.full(7, 1e9)
    said = {
        *joint_excess(much, much, much),
        *joint_excess(much, much, much, by="cartesian_motion_generator_joint"),
        *twist_excess(much[:6], much[:6], much[:6]),
        *elbow_excess(much[:1], much[:1], much[:1]),
        *torque_excess(much, 0 * much),
        *torque_excess(np.ones(7), -np.ones(7)),
    }
    assert len(said) == 12 and said <= set(ERRORS)


@pytest.mark.parametrize(
    ("velocity", "acceleration", "ended"),
    [
        (0.0, 0.0, True),
        (7.4e-3, 0.0, True),  # a jerk of 7400 rad/s^3, and back
        (7.6e-3, 0.0, False),
        (0.0, 7.6, False),
        (7.4e-3, 1.0, False),
        (0.1, 0.0, False),
    ],
)
def test_a_motion_ends_at_rest(velocity: float, acceleration: float, ended: bool) -> None:
    first = np.eye(7)[0]
    excess = excess_at_end(velocity * first, acceleration * first, joint_excess)
    assert (excess == ()) == ended
    if velocity == 0.1:
        assert excess == (f"{JOINT}_velocity_discontinuity", f"{JOINT}_acceleration_discontinuity")


# The arm.


def command(**fields: object) -> np.void:
    """A motion command."""
    record = np.zeros(1, ROBOT_COMMAND)[0]
    for name, value in fields.items():
        record[name] = value
    return record


def moving(
    generator: GeneratorMode, controller: ControllerMode = ControllerMode.JOINT_IMPEDANCE
) -> EmulatedRobot:
    """A robot at home that was just told to move."""
    robot = EmulatedRobot(model_library(), q=HOME)
    body = struct.pack("<2I", controller, generator - 1) + DEVIATIONS
    assert robot.obey(Request(RobotCommand.MOVE, 1, body))[0].status == MoveStatus.MOTION_STARTED
    return robot


def reasons(robot: EmulatedRobot) -> list[str]:
    """The names of what ended a robot's last motion."""
    flags = np.frombuffer(robot.state(0), ROBOT_STATE)[0]["reflex_reason"]
    return [name for name, flag in zip(ERRORS, flags, strict=False) if flag]


POSITION, VELOCITY = GeneratorMode.JOINT_POSITION, GeneratorMode.JOINT_VELOCITY
POSE, TWIST = GeneratorMode.CARTESIAN_POSITION, GeneratorMode.CARTESIAN_VELOCITY


def fields(generator: GeneratorMode, distance: float, speed: float, robot: EmulatedRobot) -> dict:
    """A command `distance` from the start along one direction of each generator."""
    if generator == POSITION:
        return {"q_c": HOME + distance * np.eye(7)[0]}
    if generator == VELOCITY:
        return {"dq_c": speed * np.eye(7)[0]}
    if generator == TWIST:
        return {"O_dP_EE_c": speed * np.eye(6)[2]}
    start = model_library().pose(HOME, robot.arm.F_T_EE)
    start[14] += distance
    return {"O_T_EE_c": start}


@needs_compiler
@pytest.mark.parametrize("generator", [POSITION, VELOCITY, POSE, TWIST])
def test_smooth_motions_of_all_generators_pass_and_may_end_at_rest_only(
    generator: GeneratorMode,
) -> None:
    """5 cm or 50 mrad in half a second; ended half-way, it ends in a reflex of two names."""
    path = 0.05 * np.array([min_jerk(t) for t in np.linspace(0.0, 1.0, 501)])
    speeds = np.diff(path, prepend=0.0) / DT
    for last in (len(path), 250):
        robot = moving(generator)
        for distance, speed in zip(path[:last], speeds[:last], strict=True):
            along = fields(generator, distance, speed, robot)
            assert robot.tick(command(**along).tobytes()) is None
        ended = robot.tick(command(motion_generation_finished=True, **along).tobytes())
        if last == len(path):
            assert ended.status == MoveStatus.SUCCESS and robot.mode == RobotMode.IDLE
            continue
        assert ended.status == MoveStatus.REFLEX_ABORTED and robot.mode == RobotMode.REFLEX
        family = JOINT if generator in (POSITION, VELOCITY) else CARTESIAN
        assert set(reasons(robot)) == {f"{family}_{kind}" for kind in KINDS[1:]}


@needs_compiler
@pytest.mark.parametrize("generator", [POSITION, VELOCITY])
def test_a_start_with_full_acceleration_is_too_much_jerk(generator: GeneratorMode) -> None:
    robot = moving(generator)
    speed = 10.0 * DT
    assert robot.tick(command(**fields(generator, speed * DT, speed, robot)).tobytes()) is not None
    assert reasons(robot) == [f"{JOINT}_acceleration_discontinuity"]


@needs_compiler
def test_the_joints_of_a_cartesian_motion_keep_their_limits_too() -> None:
    """The hand turns within its limits, joints 2 and 4 would have to go beyond theirs."""
    robot = moving(TWIST)
    turn = 12.0 * DT * np.eye(6)[4]
    assert robot.tick(command(O_dP_EE_c=turn).tobytes()) is not None
    assert reasons(robot) == [f"{CARTESIAN}_joint_{kind}" for kind in KINDS[1:]]


@needs_compiler
@pytest.mark.parametrize("degrees", [1.0, 90.0, 120.0, 180.0])
@pytest.mark.parametrize("axis", range(3))
def test_a_pose_that_is_turned_at_once_is_a_reflex(axis: int, degrees: float) -> None:
    """Also by half a turn, whose sine is that of none."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    R = np.roll(np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]), (axis, axis), axis=(0, 1))
    for begun in (False, True):
        robot = moving(POSE)
        pose = robot.arm.O_T_EE.copy()
        if begun:
            assert robot.tick(command(O_T_EE_c=pose).tobytes()) is None
        turned = pose.reshape(4, 4).T.copy()
        turned[:3, :3] = R @ turned[:3, :3]
        assert robot.tick(command(O_T_EE_c=turned.T.ravel()).tobytes()) is not None
        jump = f"{CARTESIAN}_velocity_discontinuity"
        expected = jump if begun else "cartesian_position_motion_generator_start_pose_invalid"
        assert expected in reasons(robot)


# The elbow.


@needs_compiler
def test_the_elbow_is_steered_while_the_hand_stays() -> None:
    robot = moving(POSE)
    still = {"O_T_EE_c": robot.arm.O_T_EE.copy(), "valid_elbow": True}
    for t in np.linspace(0.0, 1.0, 801):
        assert robot.tick(command(elbow_c=(0.2 * min_jerk(t), -1.0), **still).tobytes()) is None
    assert robot.arm.q[2] == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(robot.arm.O_T_EE, still["O_T_EE_c"], atol=1e-6)


@needs_compiler
@pytest.mark.parametrize(
    ("elbows", "name"),
    [
        ([(0.5, -1.0)], "start_elbow_invalid"),
        ([(0.0, 1.0)], "start_elbow_invalid"),
        ([(np.nan, -1.0)], "start_elbow_invalid"),
        ([(0.0, -1.0), (0.0, 1.0)], "elbow_sign_inconsistent"),
        ([(0.0, -1.0), (0.01, -1.0)], "elbow_limit_violation"),
        ([(0.0, -1.0), (np.inf, -1.0)], "elbow_limit_violation"),
    ],
)
def test_an_elbow_elsewhere_or_too_fast_is_a_reflex(elbows: list, name: str) -> None:
    robot = moving(TWIST)
    for elbow in elbows:
        ended = robot.tick(command(elbow_c=elbow, valid_elbow=True).tobytes())
    assert ended.status == MoveStatus.REFLEX_ABORTED
    assert reasons(robot) == [f"{CARTESIAN}_{name}"]


# Packets that miss.


def accelerating(ticks: int) -> np.ndarray:
    """Velocities that reach 2 rad/s^2 gently and keep it [rad/s]."""
    rates = 2.0 * np.array([min_jerk(tick / 20) for tick in range(ticks)])
    return np.cumsum(rates) * DT


@needs_compiler
@pytest.mark.parametrize("generator", [POSITION, VELOCITY, POSE, TWIST])
@pytest.mark.parametrize("missing", [1, 5, 19])
def test_a_missing_packet_is_a_sample_at_the_last_acceleration(
    generator: GeneratorMode, missing: int
) -> None:
    """Of a motion of constant acceleration it is the sample itself, so that it goes on unharmed."""
    speeds = 0.2 * accelerating(100)
    path = np.cumsum(speeds) * DT
    complete, gappy = moving(generator), moving(generator)
    for tick, (distance, speed) in enumerate(zip(path, speeds, strict=True)):
        datagram = command(**fields(generator, distance, speed, complete)).tobytes()
        assert complete.tick(datagram) is None
        lost = 40 <= tick < 40 + missing
        assert gappy.tick(None if lost else datagram) is None
        np.testing.assert_allclose(gappy.arm.q, complete.arm.q, atol=1e-9)
        np.testing.assert_allclose(gappy.arm.dq, complete.arm.dq, atol=1e-7)
    assert gappy.missed == missing and gappy.arm.dq.any()


@needs_compiler
def test_twenty_missing_packets_end_the_motion() -> None:
    robot = moving(VELOCITY)
    for speed in accelerating(60):
        assert robot.tick(command(dq_c=speed * np.eye(7)[0]).tobytes()) is None
    q = robot.arm.q.copy()
    assert [robot.tick(None) for _ in range(19)] == [None] * 19
    # A closed form: 19 ms at constant acceleration.
    travelled = speed * 0.019 + 2.0 * DT**2 * 19 * 20 / 2
    assert robot.arm.q[0] - q[0] == pytest.approx(travelled, abs=1e-9)
    assert robot.tick(None).status == MoveStatus.REFLEX_ABORTED
    assert reasons(robot) == ["communication_constraints_violation"]
    assert not robot.arm.dq.any()


@needs_compiler
def test_who_goes_on_from_where_the_gap_began_jumps() -> None:
    """The reference went on meanwhile: the trap that ends well-made motions on the robot."""
    robot = moving(POSITION)
    path = np.cumsum(accelerating(60)) * DT
    for distance in path:
        assert robot.tick(command(**fields(POSITION, distance, 0.0, robot)).tobytes()) is None
    for _ in range(5):
        assert robot.tick(None) is None
    assert robot.tick(command(**fields(POSITION, path[-1], 0.0, robot)).tobytes()) is not None
    assert f"{JOINT}_velocity_discontinuity" in reasons(robot)


@needs_compiler
def test_a_gap_that_runs_into_a_limit_is_a_reflex() -> None:
    robot = moving(VELOCITY)
    for t in np.linspace(0.0, 1.0, 401):
        assert robot.tick(command(dq_c=2.17 * min_jerk(t) * np.eye(7)[0]).tobytes()) is None
    for speed in 2.17 + np.array([0.0005, 0.0015, 0.003]):
        assert robot.tick(command(dq_c=speed * np.eye(7)[0]).tobytes()) is None
    ended = [robot.tick(None) for _ in range(4)]
    assert next(filter(None, ended)).status == MoveStatus.REFLEX_ABORTED
    assert reasons(robot) == [f"{JOINT}_velocity_limits_violation"]


@needs_compiler
def test_torques_stay_while_packets_miss() -> None:
    robot = moving(VELOCITY, ControllerMode.EXTERNAL)
    for tau in np.linspace(0.0, 2.0, 20):
        assert robot.tick(command(tau_J_d=tau * np.eye(7)[0]).tobytes()) is None
    free = Arm(model_library(), q=HOME)
    free.q, free.dq, free.tau_d = robot.arm.q, robot.arm.dq, robot.arm.tau_d
    modes = {"generator": VELOCITY, "controller": ControllerMode.EXTERNAL}
    for _ in range(10):
        assert robot.tick(None) is None
        assert free.follow(command(tau_J_d=2.0 * np.eye(7)[0]), first=False, **modes) == ()
    np.testing.assert_array_equal(robot.arm.q, free.q)
    assert robot.arm.tau_d[0] == 2.0 and robot.arm.dq[0] > 0.0
