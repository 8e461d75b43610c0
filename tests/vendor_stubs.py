"""Stand-ins for franky and frankapy: they move at once, and refuse what the real ones would."""

from __future__ import annotations

import threading
import time
from types import ModuleType, SimpleNamespace

import numpy as np

from hardware.arm.panda import HOME_Q, PandaKinematics
from hardware.arm.straight_line import straight_line

ARM = PandaKinematics()


def follow(world: SimpleNamespace, target: np.ndarray) -> None:
    """Put the arm where a straight motion ends, `offset` [m] too high."""
    reached = target.copy()
    reached[2, 3] += world.offset
    world.q = straight_line(ARM, world.q, reached, speed=0.1).q[-1]
    world.T = ARM.pose(world.q)


class _Condition:
    """Names a condition, as franky's objects do."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __or__(self, other: object) -> _Condition:
        return _Condition(f"{self.text} or {getattr(other, 'text', other)}")


class _Measure:
    def __init__(self, name: str) -> None:
        self.name = name

    def __gt__(self, value: float) -> _Condition:
        return _Condition(f"{self.name} > {value:g}")

    def __lt__(self, value: float) -> _Condition:
        return _Condition(f"{self.name} < {value:g}")


def make_franky() -> tuple[ModuleType, SimpleNamespace]:
    """The package, and what its robot is and does."""
    world = SimpleNamespace(
        q=np.array(HOME_Q),
        T=ARM.pose(np.array(HOME_Q)),
        force=np.zeros(6),
        mode="Idle",
        width=0.08,
        object=0.0,
        moves=[],
        grasps=[],
        fail=None,
        contact=False,
        offset=0.0,
        connect=None,
        thresholds=None,
        stops=0,
        recoveries=0,
    )
    franky = ModuleType("franky")

    class Base(Exception):
        pass

    names = (
        "ControlException",
        "CommandException",
        "NetworkException",
        "ModelException",
        "IncompatibleVersionException",
    )
    for name in names:
        setattr(franky, name, type(name, (Base,), {}))
    franky.Exception = Base
    franky.GripperException = type("GripperException", (Exception,), {})
    franky.RealtimeConfig = SimpleNamespace(Ignore="ignore", Enforce="enforce")
    franky.Measure = SimpleNamespace(**{n: _Measure(n) for n in ("FORCE_X", "FORCE_Y", "FORCE_Z")})

    class Affine:
        def __init__(self, matrix: np.ndarray) -> None:
            assert np.shape(matrix) == (4, 4)
            self.matrix = np.array(matrix, dtype=float)

    class JointState:
        def __init__(self, position: list[float]) -> None:
            assert len(position) == 7
            self.position = np.array(position)

    class Limit:
        def __init__(self, most: list[float]) -> None:
            self.most, self.value = np.array(most), list(most)

        def get(self) -> list[float]:
            return self.value

        def set(self, value: list[float]) -> None:
            assert len(value) == 7 and (0.0 < np.array(value)).all()
            assert (np.array(value) <= self.most + 1e-12).all()
            self.value = value

    class Motion:
        def __init__(self, target: object, *, relative_dynamics_factor: float = 1.0) -> None:
            assert 0.0 < relative_dynamics_factor <= 1.0
            self.target, self.factor = target, relative_dynamics_factor
            self.reactions: list[Reaction] = []

        def add_reaction(self, reaction: Reaction) -> None:
            self.reactions.append(reaction)

    class CartesianMotion(Motion):
        pass

    class JointMotion(Motion):
        pass

    class CartesianStopMotion:
        pass

    class Reaction:
        def __init__(self, condition: _Condition, motion: CartesianStopMotion) -> None:
            assert isinstance(motion, CartesianStopMotion)
            self.condition, self.callbacks = condition, []

        def register_callback(self, callback: object) -> None:
            self.callbacks.append(callback)

    class Robot:
        translation_velocity_limit = SimpleNamespace(get=lambda: 2.0)

        def __init__(self, host: str, *, realtime_config: str) -> None:
            assert realtime_config == "ignore"
            self.joint_velocity_limit = Limit([2.62] * 4 + [5.26, 4.18, 5.26])
            self.joint_acceleration_limit = Limit([10.0] * 7)
            self.joint_jerk_limit = Limit([5000.0] * 7)
            if world.connect is not None:
                raise world.connect

        @property
        def state(self) -> SimpleNamespace:
            return SimpleNamespace(
                q=world.q,
                O_T_EE=Affine(world.T),
                O_F_ext_hat_K=world.force,
                robot_mode=SimpleNamespace(name=world.mode),
            )

        def set_collision_behavior(self, torque: float, force: float) -> None:
            world.thresholds = (torque, force)

        def move(self, motion: Motion) -> None:
            world.moves.append(motion)
            if world.fail is not None:
                raise world.fail
            if isinstance(motion, JointMotion):
                motion.limits = [
                    np.array(limit.get())
                    for limit in (
                        self.joint_velocity_limit,
                        self.joint_acceleration_limit,
                        self.joint_jerk_limit,
                    )
                ]
                motion.start = world.q
                world.q = motion.target.position
                world.T = ARM.pose(world.q)
                return
            follow(world, motion.target.matrix)
            if world.contact:
                for reaction in motion.reactions:
                    for callback in reaction.callbacks:
                        callback(None, 0.0, 0.0)

        def stop(self) -> None:
            world.stops += 1

        def recover_from_errors(self) -> bool:
            world.mode = "Idle"
            world.recoveries += 1
            return True

    class Gripper:
        def __init__(self, host: str) -> None:
            pass

        @property
        def width(self) -> float:
            return world.width

        def move(self, width: float, speed: float) -> bool:
            world.width = width
            return True

        def grasp(
            self,
            width: float,
            speed: float,
            force: float,
            epsilon_inner: float,
            epsilon_outer: float,
        ) -> bool:
            world.grasps.append((width, speed, force, epsilon_inner, epsilon_outer))
            world.width = world.object
            return False  # outside of a tolerance; the width decides

        def stop(self) -> bool:
            return True

    made = (Affine, JointState, CartesianMotion, JointMotion,
            CartesianStopMotion, Robot, Gripper)  # fmt: skip
    for cls in made:
        setattr(franky, cls.__name__, cls)
    franky.CartesianPoseReaction = Reaction
    return franky, world


def make_frankapy() -> tuple[dict[str, ModuleType], SimpleNamespace]:
    """The modules by name, and what the robot does."""
    world = SimpleNamespace(
        q=np.array(HOME_Q),
        T=ARM.pose(np.array(HOME_Q)),
        force=np.zeros(6),
        width=0.08,
        object=0.0,
        calls=[],
        fail=None,
        offset=0.0,
        settling=2,
        busy=False,
        absent=(),
        made=0,
    )

    class RigidTransform:
        def __init__(
            self, rotation: np.ndarray, translation: np.ndarray, from_frame: str, to_frame: str
        ) -> None:
            self.rotation, self.translation = rotation, translation
            self.from_frame, self.to_frame = from_frame, to_frame

    exceptions = ModuleType("frankapy.exceptions")
    for name in (
        "FrankaArmCommException",
        "FrankaArmFrankaInterfaceNotReadyException",
        "FrankaArmException",
    ):
        setattr(exceptions, name, type(name, (Exception,), {}))

    class FrankaArm:
        def __init__(self, *, robot_num: int) -> None:
            import signal

            signal.signal(signal.SIGINT, lambda *_: None)  # as the real one does
            world.made += 1
            if world.fail is not None:
                raise world.fail

        def get_pose(self) -> RigidTransform:
            return RigidTransform(world.T[:3, :3], world.T[:3, 3], "franka_tool", "world")

        def get_joints(self) -> np.ndarray:
            return world.q

        def get_ee_force_torque(self) -> np.ndarray:
            return world.force

        def get_gripper_width(self) -> float:
            # the fingers are still on their way when the command returns
            if world.settling:
                world.settling -= 1
                return world.width + 0.01 * (world.settling + 1)
            return world.width

        def is_skill_done(self, *, ignore_errors: bool) -> bool:
            assert ignore_errors is False
            return not world.busy

        def goto_pose(
            self,
            tool_pose: RigidTransform,
            *,
            duration: float,
            use_impedance: bool,
            force_thresholds: list[float] | None,
            block: bool,
            ignore_errors: bool,
        ) -> None:
            assert (tool_pose.from_frame, tool_pose.to_frame) == ("franka_tool", "world")
            assert ignore_errors is False and block and not use_impedance
            world.calls.append(("goto_pose", duration, force_thresholds))
            if world.fail is not None:
                raise world.fail
            target = np.eye(4)
            target[:3, :3], target[:3, 3] = tool_pose.rotation, tool_pose.translation
            follow(world, target)

        def goto_joints(
            self,
            joints: list[float],
            *,
            duration: float,
            use_impedance: bool,
            block: bool,
            ignore_errors: bool,
        ) -> None:
            assert ignore_errors is False and block and not use_impedance
            world.calls.append(("goto_joints", duration))
            if world.fail is not None:
                raise world.fail
            world.q = np.array(joints)
            world.T = ARM.pose(world.q)

        def goto_gripper(self, width: float, **settings: object) -> None:
            world.calls.append(("goto_gripper", width, settings))
            world.width = world.object if settings["grasp"] else width

        def stop_skill(self) -> None:
            world.busy = False
            world.calls.append(("stop_skill",))

    rospy = ModuleType("rospy")
    rospy.ROSException = type("ROSException", (Exception,), {})

    def wait_for_service(name: str, timeout: float) -> None:
        assert timeout > 0.0, "0 or None would wait for ever"
        if "master" in world.absent:
            threading.Event().wait(20.0)
        if name in world.absent:
            time.sleep(timeout)
            raise rospy.ROSException(f"timeout exceeded while waiting for service {name}")

    def get_published_topics() -> list[list[str]]:
        actions = ["/execute_skill_action_server_node_1/execute_skill"]
        actions += [f"/franka_gripper_1/{name}" for name in ("homing", "move", "grasp")]
        return [[f"{name}/status", "type"] for name in actions if name not in world.absent]

    rospy.wait_for_service, rospy.get_published_topics = wait_for_service, get_published_topics
    package, core = ModuleType("frankapy"), ModuleType("autolab_core")
    package.FrankaArm, package.exceptions = FrankaArm, exceptions
    core.RigidTransform = RigidTransform
    modules = {"frankapy": package, "frankapy.exceptions": exceptions, "autolab_core": core}
    return {**modules, "rospy": rospy}, world
