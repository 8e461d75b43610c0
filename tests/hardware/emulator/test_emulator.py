"""The emulated Panda under the vendor's unmodified client: motions, limits, contact, fingers."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.emulator_client import (
    HOME,
    OFF_HOME,
    libfranka,
    min_jerk,
    panda_py,
    timed,
)
from fixtures.emulator_worlds import TABLE_Z

from hardware.arm.panda import Q_MAX, Q_MIN, PandaKinematics
from hardware.emulator import EmulatorProcess
from hardware.emulator.protocol import ERRORS

pytestmark = pytest.mark.emulator


def test_clients_model_is_the_emulators(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    emulator.place(OFF_HOME)
    state = panda.robot.read_once()
    state = panda.robot.read_once()
    model = panda.panda.get_model()
    assert model.pose(libfranka.Frame.kEndEffector, state) == list(state.O_T_EE)
    own = np.array(model.body_jacobian(libfranka.Frame.kEndEffector, state)).reshape(7, 6).T
    base = np.array(model.zero_jacobian(libfranka.Frame.kEndEffector, state)).reshape(7, 6).T
    R = np.array(state.O_T_EE).reshape(4, 4).T[:3, :3]
    np.testing.assert_allclose(np.kron(np.eye(2), R) @ own, base, atol=1e-12)


def test_vendors_kinematics_are_within_half_a_millimetre() -> None:
    """Its formula takes the hand for 0.4 mm shorter than the robot does."""
    for q in np.random.default_rng(0).uniform(Q_MIN, Q_MAX, (20, 7)):
        off = panda_py.fk(q)[:3, 3] - PandaKinematics().pose(q)[:3, 3]
        assert 3e-4 < np.linalg.norm(off) < 5e-4


# The motion generators.


def test_joint_trajectory_by_torques(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    assert panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)
    seen = emulator.snapshot()
    assert np.abs(seen["q"] - OFF_HOME).max() < 5e-4
    assert seen["mode"] == "idle"
    record = emulator.call_world("take")
    assert len(record["dt"]) > 1000
    assert set(record["dt"]) == {1e-3}


def test_joint_position_generator(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    goal = HOME + 0.2 * np.eye(7)[0]

    def make(t: float, state: object) -> object:
        return libfranka.JointPositions(list(HOME + min_jerk(t) * (goal - HOME)))

    panda.robot.control_joint_position(timed(make, seconds=1.2))
    # The client's own low-pass filter keeps a little of the last step.
    np.testing.assert_allclose(emulator.snapshot()["q"], goal, atol=1e-8)


def test_joint_velocity_generator(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    panda.robot.control_joint_velocity(timed(bump(0.5), seconds=1.2))
    assert emulator.snapshot()["q"][0] == pytest.approx(0.25, abs=1e-3)


def test_cartesian_pose_generator(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    start = PandaKinematics().pose(HOME)

    def make(t: float, state: object) -> object:
        T = start.copy()
        T[2, 3] -= 0.05 * min_jerk(t)
        return libfranka.CartesianPose(list(T.T.ravel()))

    panda.robot.control_cartesian_pose(timed(make, seconds=1.2))
    reached = emulator.snapshot()["base_T_tcp"]
    np.testing.assert_allclose(reached[:3, 3] - start[:3, 3], [0, 0, -0.05], atol=1e-7)
    np.testing.assert_allclose(reached[:3, :3], start[:3, :3], atol=1e-7)


def test_cartesian_velocity_generator(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    def make(t: float, state: object) -> object:
        return libfranka.CartesianVelocities(
            [0, 0.1 * np.sin(np.pi * min(t, 1.0)) ** 2, 0, 0, 0, 0]
        )

    panda.robot.control_cartesian_velocity(timed(make, seconds=1.2))
    moved = emulator.snapshot()["base_T_tcp"][:3, 3] - PandaKinematics().pose(HOME)[:3, 3]
    np.testing.assert_allclose(moved, [0, 0.05, 0], atol=2e-4)


# Limits.


def bump(speed: float) -> Callable[[float, object], object]:
    """Turn joint 1 for a second, at rest in the end; half of `speed` on average [rad/s]."""
    return lambda t, state: libfranka.JointVelocities(
        [speed * np.sin(np.pi * min(t, 1.0)) ** 2, *[0.0] * 6]
    )


def velocities(speed: float) -> Callable[[float, object], object]:
    return lambda t, state: libfranka.JointVelocities([speed * min_jerk(2 * t), *[0.0] * 6])


def test_velocity_limit(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    with pytest.raises(RuntimeError, match="joint_motion_generator_velocity_limits_violation"):
        panda.robot.control_joint_velocity(timed(velocities(2.5), seconds=2.0), limit_rate=False)
    assert emulator.snapshot()["mode"] == "reflex"


def test_velocity_jump(panda: SimpleNamespace) -> None:
    jump = timed(lambda t, state: libfranka.JointVelocities([1.0, *[0.0] * 6]), seconds=1.0)
    with pytest.raises(RuntimeError, match="joint_motion_generator_velocity_discontinuity"):
        panda.robot.control_joint_velocity(jump, limit_rate=False, cutoff_frequency=1000.0)


def test_acceleration_jump(panda: SimpleNamespace) -> None:
    """10 rad/s^2 from the first sample on: within the acceleration's limit, beyond the jerk's."""
    jump = timed(lambda t, state: libfranka.JointVelocities([10.0 * t, *[0.0] * 6]), seconds=1.0)
    only = r'reflex! \["joint_motion_generator_acceleration_discontinuity"\]'
    with pytest.raises(RuntimeError, match=only):
        panda.robot.control_joint_velocity(jump, limit_rate=False, cutoff_frequency=1000.0)


def test_a_motion_that_ends_while_moving_is_none(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    with pytest.raises(RuntimeError, match="finished commanded, but the robot is still moving"):
        panda.robot.control_joint_velocity(timed(velocities(0.5), seconds=1.0))
    assert emulator.snapshot()["mode"] == "reflex"


def test_joint_limit(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    with pytest.raises(RuntimeError, match="joint_motion_generator_position_limits_violation"):
        panda.robot.control_joint_velocity(timed(velocities(2.0), seconds=3.0))
    assert Q_MAX[0] - 0.01 < emulator.snapshot()["q"][0] <= Q_MAX[0]
    panda.panda.recover()
    panda.robot.control_joint_velocity(timed(bump(-0.5), seconds=1.2))  # and back
    assert emulator.snapshot()["q"][0] < Q_MAX[0] - 0.1


def test_start_pose_must_be_the_arms(panda: SimpleNamespace) -> None:
    elsewhere = timed(lambda t, s: libfranka.JointPositions(list(HOME + 0.1)), seconds=1.0)
    with pytest.raises(RuntimeError, match="joint_position_motion_generator_start_pose_invalid"):
        panda.robot.control_joint_position(elsewhere, limit_rate=False, cutoff_frequency=1000.0)


def test_torque_jump(panda: SimpleNamespace) -> None:
    jump = timed(lambda t, state: libfranka.Torques([20.0, *[0.0] * 6]), seconds=1.0)
    with pytest.raises(RuntimeError, match="controller_torque_discontinuity"):
        panda.robot.control(jump, limit_rate=False, cutoff_frequency=1000.0)


def test_every_reflex_has_the_vendors_name(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    wrong = {}
    for name in ERRORS:
        emulator.inject_reflex(name, after_ticks=5)
        assert not panda.panda.move_to_joint_position(OFF_HOME, speed_factor=0.2)
        with pytest.raises(RuntimeError) as caught:
            panda.panda.raise_error()
        if f'reflex! ["{name}"]' not in str(caught.value):
            wrong[name] = str(caught.value)
        panda.panda.recover()
    assert wrong == {}


# Contact.


def test_table_pushes_back_and_too_hard_a_push_is_a_reflex(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    start = PandaKinematics().pose(HOME)

    def down(t: float, state: object) -> object:
        T = start.copy()
        T[2, 3] -= (start[2, 3] - TABLE_Z + 0.02) * min_jerk(t / 4)
        return libfranka.CartesianPose(list(T.T.ravel()))

    with pytest.raises(RuntimeError, match="cartesian_reflex"):
        panda.robot.control_cartesian_pose(timed(down, seconds=4.2))
    record = emulator.call_world("take")
    touching = record["position"][:, 2] < TABLE_Z
    assert (record["force"][~touching] == 0.0).all()
    assert (record["force"][:-1] <= 10.0).all() and record["force"][-1] > 10.0
    panda.robot.read_once()
    assert panda.robot.read_once().O_F_ext_hat_K[2] == pytest.approx(record["force"][-1])


def test_an_arm_under_torque_control_gives_way_to_the_table(
    panda: SimpleNamespace, emulator: EmulatorProcess
) -> None:
    """Pressed on the table by a constant torque, the force is what the Jacobian says."""
    q = np.array([0.0, 0.37, 0.0, -2.2, 0.0, 2.57, 0.785])
    arm = PandaKinematics()
    assert arm.pose(q)[2, 3] > TABLE_Z
    emulator.place(q)
    J = arm.jacobian(q)
    stiff, damp = 600.0, 60.0
    press = J.T @ [0, 0, -8.0, 0, 0, 0]

    def make(t: float, state: object) -> object:
        tau = press * min_jerk(2 * t) - damp * np.array(state.dq)
        tau -= stiff * np.array([1, 0, 1, 0, 1, 0, 1]) * (np.array(state.q) - q)
        return libfranka.Torques(list(tau))

    panda.robot.control(timed(make, seconds=4.0))
    record = emulator.call_world("take")
    assert record["force"][-1] == pytest.approx(8.0, rel=0.15)
    assert record["speed"][-1] < 5e-3


def test_gripper_over_the_wire(panda: SimpleNamespace, emulator: EmulatorProcess) -> None:
    gripper = panda.gripper
    assert gripper.homing()
    assert gripper.move(0.03, 0.1)
    assert gripper.read_once().width == 0.03
    emulator.call_world("place_object", width=0.006)
    assert gripper.grasp(0.006, 0.05, 20.0, 0.005, 0.005)
    assert (gripper.read_once().width, gripper.read_once().is_grasped) == (0.006, True)
    assert gripper.move(0.08, 0.1)
    emulator.call_world("place_object", width=0.0)
    assert not gripper.grasp(0.02, 0.05, 20.0, 0.005, 0.005)
    widths = emulator.call_world("take")["width"]
    assert (np.abs(np.diff(widths)) <= 1.01e-4).all()  # 0.1 m/s at most, a step each millisecond
    assert gripper.move(0.08, 0.1)
