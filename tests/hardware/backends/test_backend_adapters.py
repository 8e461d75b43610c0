"""The FR3 through franky and a Panda through frankapy, against stand-ins for both."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.vendor_stubs import ARM, make_frankapy, make_franky

from hardware import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    GraspError,
    IncompatibleVersion,
    MotionError,
    ReflexError,
    Robot,
    RobotMode,
    UnreachablePose,
    UserStopped,
)
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import DQ_MAX, HOME_Q, Q_MAX
from hardware.arm.pick_place import PickPlaceAction, execute
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.backends.fr3 import FR3_Q_MAX, FR3_Q_MIN, FR3Robot
from hardware.backends.frankapy import FrankapyConfig, FrankapyRobot
from warp_deform.errors import InputError

HOME = np.array(HOME_Q)
LOWER = ARM.pose(HOME)
LOWER[2, 3] -= 0.1
ACTION = PickPlaceAction((0.45, 0.0), 0.3, (0.5, 0.1), 0.3)
STATUS = "get_current_franka_interface_status_server"
STATUS_SERVER = f"/{STATUS}_node_1/{STATUS}"
LIMITS = SafetyLimits(table=TablePlane(0.0))


@pytest.fixture
def franky(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    module, world = make_franky()
    monkeypatch.setitem(sys.modules, "franky", module)
    world.module = module
    return world


@pytest.fixture
def frankapy(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    modules, world = make_frankapy()
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    world.exceptions = modules["frankapy.exceptions"]
    handler = signal.getsignal(signal.SIGINT)
    yield world
    assert signal.getsignal(signal.SIGINT) is handler, "Ctrl-C still reaches us"


def refuses_to_move(robot: Robot) -> None:
    """Assert that a stop holds: no motion of arm or fingers begins."""
    for call in (
        lambda: robot.move_joints(HOME + 0.1, speed=0.1),
        lambda: robot.move_linear(LOWER, speed=0.1),
        robot.open_gripper,
    ):
        with pytest.raises(MotionError, match="holds until recover"):
            call()


def slow_free() -> FrankapyRobot:
    return FrankapyRobot(sleep=lambda seconds: None, say=lambda line: None)


@pytest.mark.parametrize("cls", [FR3Robot, FrankapyRobot])
def test_the_adapters_have_the_protocols_methods(cls: type) -> None:
    methods = {name for name in vars(Robot) if callable(getattr(Robot, name)) and name[0] != "_"}
    assert methods <= set(dir(cls))


@pytest.mark.parametrize(
    ("cls", "module", "advice"),
    [(FR3Robot, "franky", r"-e '\.\[fr3\]'"), (FrankapyRobot, "frankapy", "ROS workspace")],
)
def test_a_missing_package_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, cls: type, module: str, advice: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(BackendMissing, match=advice):
        cls()


# The FR3.


def test_an_fr3_reads_moves_and_places(franky: SimpleNamespace) -> None:
    franky.object = 0.005
    with FR3Robot() as robot:
        assert franky.thresholds == (20.0, 20.0) and franky.moves == []
        state = robot.state()
        np.testing.assert_array_equal(state.q, HOME)
        np.testing.assert_allclose(state.base_T_tcp, ARM.pose(HOME))
        assert state.mode is RobotMode.IDLE and state.gripper_width_m == 0.08
        result = execute(SafeRobot(robot, LIMITS), ACTION)
        assert result.outcome == "placed" and result.width_after_lift_m == 0.005
    width, _, force, *tolerances = franky.grasps[0]
    assert (width, force) == (0.010, 10.0) and min(tolerances) >= 0.08, "else the hand reopens"
    with pytest.raises(ConnectionLost, match="closed"):
        robot.state()


def test_an_fr3s_speeds_and_reactions(franky: SimpleNamespace) -> None:
    robot = FR3Robot()
    assert not robot.move_linear(LOWER, speed=0.05, stop_force_N=8.0).contact
    motion = franky.moves[-1]
    # Each of three axes may be at its limit at once: a slanting line went 1.7 times too fast.
    assert np.sqrt(3.0) * motion.factor * 2.0 == pytest.approx(0.05)
    said = motion.reactions[0].condition.text
    assert all(
        f"{axis} > 8" in said and f"{axis} < -8" in said
        for axis in ("FORCE_X", "FORCE_Y", "FORCE_Z")
    )
    turns = np.array([0.05, -0.02, 0.0, 0.05, 0.1, 0.0, 0.2])
    robot.move_joints(np.array([HOME + turns, HOME]), speed=0.1)
    for motion in franky.moves[-2:]:
        way = np.abs(motion.target.position - motion.start)
        for limit in motion.limits:
            # in proportion to the ways: the profiles are alike, and the joints go straight
            moving = way > 1e-5
            np.testing.assert_allclose((limit / limit.max())[moving], (way / way.max())[moving])
        assert (motion.limits[0] <= 0.1 * DQ_MAX + 1e-9).all()
        assert (motion.limits[0] / DQ_MAX).max() == pytest.approx(0.1)
        assert (motion.limits[1] <= 0.1 * 10.0 + 1e-9).all()
    assert robot._robot.joint_velocity_limit.get() == [2.62] * 4 + [5.26, 4.18, 5.26]
    franky.contact, franky.offset = True, 0.04
    assert robot.move_linear(LOWER, speed=0.05, stop_force_N=8.0).contact
    franky.contact = False
    with pytest.raises(MotionError, match=r"40\.0 mm"):
        robot.move_linear(LOWER, speed=0.05, stop_force_N=8.0)


def test_an_fr3_has_its_own_joint_limits(franky: SimpleNamespace) -> None:
    robot = FR3Robot()
    low = HOME.copy()
    low[5] = 0.3  # a Panda's sixth joint may, an FR3's may not
    with pytest.raises(InputError, match="joint 6"):
        robot.move_joints(low, speed=0.1)
    assert franky.moves == [] and (FR3_Q_MIN < FR3_Q_MAX).all() and Q_MAX[5] < FR3_Q_MAX[5]


@pytest.mark.parametrize(
    ("name", "message", "kind"),
    [
        ("ControlException", 'motion aborted by reflex! ["cartesian_reflex"]', ReflexError),
        ("ControlException", "User Stop pressed!", UserStopped),
        ("CommandException", "Move command rejected", MotionError),
        ("NetworkException", "UDP receive: Timeout", ConnectionLost),
    ],
)
def test_frankys_exceptions_get_our_types(
    franky: SimpleNamespace, name: str, message: str, kind: type
) -> None:
    robot = FR3Robot()
    franky.fail = getattr(franky.module, name)(f"libfranka: {message}")
    with pytest.raises(kind) as raised:
        robot.move_linear(LOWER, speed=0.05)
    assert type(raised.value) is kind
    if kind is ReflexError:
        assert raised.value.reflexes == ("cartesian_reflex",)


def test_connecting_to_an_fr3_fails_in_two_ways(franky: SimpleNamespace) -> None:
    franky.connect = franky.module.IncompatibleVersionException("server version: 5")
    with pytest.raises(IncompatibleVersion, match="--robot panda"):
        FR3Robot()
    franky.connect = franky.module.NetworkException("Connection to FCI refused")
    with pytest.raises(ConnectionFailed, match="activate FCI"):
        FR3Robot()


def test_an_fr3_recovers_whatever_its_state_says_and_not_from_the_user_stop(
    franky: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits: list[float] = []

    def spy(call: Callable[[], object], *, timeout_s: float, stop: object = None) -> object:
        limits.append(timeout_s)
        return call()

    robot = FR3Robot()
    monkeypatch.setattr("hardware.backends.fr3.run_bounded", spy)
    for number, mode in enumerate(("Reflex", "Other", "Idle"), start=1):
        franky.mode = mode
        robot.recover()
        assert robot.state().mode is RobotMode.IDLE and franky.recoveries == number
    assert limits.count(30.0) == 3  # users measured 16 s
    for mode, kind in (("UserStopped", UserStopped), ("Guiding", ReflexError)):
        franky.mode = mode
        with pytest.raises(kind):
            robot.recover()
    assert franky.recoveries == 3
    robot.stop()
    assert franky.stops == 1
    refuses_to_move(robot)
    assert franky.moves == []
    franky.mode = "Idle"
    robot.recover()
    robot.move_linear(LOWER, speed=0.1)


# frankapy; the stand-in itself asserts frames and ignore_errors.


def test_frankapy_reads_moves_and_places(frankapy: SimpleNamespace) -> None:
    frankapy.object = 0.005
    robot = slow_free()
    assert frankapy.calls == []
    np.testing.assert_allclose(robot.state().base_T_tcp, ARM.pose(HOME))
    result = execute(SafeRobot(robot, LIMITS), ACTION)
    assert result.outcome == "placed" and result.width_after_grasp_m == 0.005
    grasp = next(call for call in frankapy.calls if call[0] == "goto_gripper" and call[2]["grasp"])
    assert grasp[2]["force"] == 10.0 and grasp[2]["epsilon_outer"] >= 0.08
    robot.close()
    with pytest.raises(ConnectionLost):
        robot.state()


@pytest.mark.parametrize(
    ("absent", "named"),
    [
        ("master", "get_current_robot_state_server"),
        (STATUS_SERVER, STATUS_SERVER),
        ("/franka_gripper_1/move", "/franka_gripper_1/move"),
    ],
)
def test_frankapys_servers_are_not_waited_for_without_end(
    frankapy: SimpleNamespace, absent: str, named: str
) -> None:
    frankapy.absent = (absent,)
    said: list[str] = []
    config = FrankapyConfig(connect_timeout_s=0.2)
    with pytest.raises(ConnectionFailed, match=rf"{named} is not there after 0\.2 s.*roscore"):
        FrankapyRobot(config, say=said.append)
    assert frankapy.made == 0, "its own wait has no end"
    assert len(said) == 1 and "waiting" in said[0] and named in said[0]
    frankapy.absent = ()
    FrankapyRobot(say=said.append)
    assert len(said) == 1 and frankapy.made == 1


def test_frankapys_durations_keep_the_speed(frankapy: SimpleNamespace) -> None:
    """A minimum-jerk motion's greatest speed is 1.875 of its mean."""
    slow_free().move_linear(LOWER, speed=0.05, stop_force_N=8.0)
    _, seconds, thresholds = frankapy.calls[-1]
    assert 1.875 * 0.1 / seconds == pytest.approx(0.05) and thresholds == [8.0] * 3 + [20.0] * 3
    slow_free().move_joints(HOME + 0.1, speed=0.1)
    assert 1.875 * 0.1 / frankapy.calls[-1][1] <= 0.1 * DQ_MAX.max()


def test_frankapys_stop_holds(frankapy: SimpleNamespace) -> None:
    robot = slow_free()
    robot.stop()
    made = len(frankapy.calls)
    refuses_to_move(robot)
    assert len(frankapy.calls) == made
    robot.recover()
    robot.move_linear(LOWER, speed=0.1)


def test_frankapys_contact_is_told_by_force_and_place(frankapy: SimpleNamespace) -> None:
    robot = slow_free()
    frankapy.offset = 0.03
    with pytest.raises(MotionError, match=r"30\.0 mm"):
        robot.move_linear(LOWER, speed=0.05, stop_force_N=8.0)
    frankapy.force = np.array([0.0, 0.0, 7.0, 0.0, 0.0, 0.0])
    assert robot.move_linear(LOWER, speed=0.05, stop_force_N=8.0).contact


def test_frankapys_fingers_are_watched_until_they_stand(frankapy: SimpleNamespace) -> None:
    robot = slow_free()
    frankapy.settling = 3
    assert not robot.grasp(width_m=0.01, force_N=10.0), "closed on nothing"
    frankapy.settling = 1000
    with pytest.raises(GraspError, match="stand in time"):
        robot.open_gripper(0.03)


def test_frankapys_exceptions_get_our_types(frankapy: SimpleNamespace) -> None:
    robot = slow_free()
    known = frankapy.exceptions
    for error, kind in (
        (known.FrankaArmCommException("no answer"), ConnectionLost),
        (known.FrankaArmFrankaInterfaceNotReadyException("no"), ConnectionLost),
        (known.FrankaArmException("cartesian_reflex"), ReflexError),
        (known.FrankaArmException("failed"), MotionError),
        (ValueError("Target pose is outside of workspace virtual walls!"), UnreachablePose),
    ):
        frankapy.fail = error
        with pytest.raises(kind) as raised:
            robot.move_linear(LOWER, speed=0.05)
        assert type(raised.value) is kind
    frankapy.fail = known.FrankaArmCommException("no control PC")
    with pytest.raises(ConnectionFailed, match="control PC"):
        FrankapyRobot()
    frankapy.fail = None
    frankapy.busy = True
    assert robot.state().mode is RobotMode.MOVING
    robot.recover()
    assert robot.state().mode is RobotMode.IDLE
