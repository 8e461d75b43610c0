"""The twin of the physical workspace: chain, foam, simulated robot and camera.

Under the vendor's client it is in `episodes/test_episode.py`.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from fixtures.robot_refusals import refuses_what_the_arm_cannot_do

from hardware import (
    ConnectionLost,
    GraspError,
    MotionError,
    ReflexError,
    Robot,
    RobotMode,
)
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q, PandaKinematics
from hardware.arm.pick_place import PickPlaceAction, PickPlaceConfig, PickPlaceOutcome, execute
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.straight_line import distance
from hardware.cameras.camera import CameraError
from hardware.emulator import Contact, Hand, TableWorld
from hardware.twin.camera import SimCamera, SimCameraConfig, sim_calibration
from hardware.twin.robot import SimRobot, SimRobotConfig
from hardware.twin.twin import CableTwin, TwinConfig
from hardware.vision.segmentation import segment_cable
from hardware.vision.top_down_view import TopDownView
from warp_deform.errors import InputError
from warp_deform.robots.jaw_primitive import JawActionConfig
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import straight_chain
from warp_deform.tasks.metrics import mask_iou

ARM = PandaKinematics()
HOME = np.array(HOME_Q)
CONFIG = TwinConfig()
LIMITS = SafetyLimits(table=CONFIG.table)
FOAM = np.array([0.0, 0.0, CONFIG.foam_height_m])
ALONG_Y = straight_chain(CONFIG.chain, np.array([0.45, 0.0]), np.pi / 2) + FOAM
MIDDLE = PickPlaceAction((0.45, 0.0), np.pi / 2, (0.55, 0.05), np.pi / 2)


@pytest.fixture(scope="module")
def shared() -> CableTwin:
    return CableTwin()


@pytest.fixture
def twin(shared: CableTwin) -> CableTwin:
    shared.lay(ALONG_Y)
    return shared


def lengths(beads: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(beads, axis=0), axis=1) / CONFIG.chain.spacing


# Chain and foam.


def test_a_toss_lies_still_on_the_foam_and_depends_on_its_seed(twin: CableTwin) -> None:
    starts = []
    for seed in (3, 4, 3):
        twin.toss(seed)
        beads = twin.look().beads
        starts.append(beads)
        assert np.abs(lengths(beads) - 1.0).max() < 0.01
        assert beads[:, 2].min() > FOAM[2] + 0.9 * CONFIG.chain.radius
        assert beads[:, 2].max() < FOAM[2] + 5 * CONFIG.chain.radius
        view = CONFIG.view
        assert (beads[:, :2] > (view.x[0], view.y[0])).all()
        assert (beads[:, :2] < (view.x[1], view.y[1])).all()
    np.testing.assert_array_equal(starts[0], starts[2])
    assert np.abs(starts[0] - starts[1]).max() > 0.02
    twin.toss(3, 1)
    assert np.abs(twin.look().beads - starts[0]).max() > 0.02, "tossed again"
    with pytest.raises(InputError, match="a seed is 0"):
        TwinConfig(seed=-1)
    other = CableTwin(TwinConfig(seed=3)).look().beads
    np.testing.assert_array_equal(other, starts[0])


def test_nothing_moves_under_a_hand_at_home(twin: CableTwin) -> None:
    before = twin.look().beads
    hand = Hand(ARM.pose(HOME), np.zeros(3), 0.08, False, 1e-3)
    assert {twin.step(hand) for _ in range(2000)} == {Contact()}
    np.testing.assert_array_equal(twin.look().beads, before)


def test_a_chain_of_another_size_is_refused(twin: CableTwin) -> None:
    for wrong in (ALONG_Y[:-1], ALONG_Y * np.nan):
        with pytest.raises(InputError, match="90 beads"):
            twin.lay(wrong)


def test_simulation_and_hardware_agree_on_the_workspace_and_the_motion() -> None:
    task, view = CableMaskGoal(), TopDownView()
    assert (task.x, task.y) == (view.x, view.y) == (LIMITS.x, LIMITS.y)
    pixels = np.array([[0, 0], [319, 159], [100, 20]])
    np.testing.assert_allclose(task.grid.to_world(pixels), view.pixel_to_base(pixels), atol=1e-12)
    ours = {field.name for field in fields(JawActionConfig)}
    for name in ours & {field.name for field in fields(PickPlaceConfig)}:
        assert getattr(JawActionConfig(), name) == getattr(PickPlaceConfig(), name)
    assert task.stages[0].lift == PickPlaceConfig().lift_m


# The simulated robot.


def test_the_simulated_robot_has_the_protocols_methods() -> None:
    methods = {name for name in vars(Robot) if callable(getattr(Robot, name)) and name[0] != "_"}
    assert methods <= set(dir(SimRobot))


def test_motions_arrive_and_take_their_time() -> None:
    class Clock(TableWorld):
        seconds = fastest = 0.0
        last = None

        def step(self, hand: Hand) -> Contact:
            self.seconds += hand.dt
            here = hand.base_T_tcp[:3, 3]
            if self.last is not None:
                self.fastest = max(self.fastest, np.linalg.norm(here - self.last) / hand.dt)
            self.last = here.copy()
            return super().step(hand)

    world = Clock()
    with SimRobot(world) as robot:
        assert robot.state().mode == RobotMode.IDLE
        target = ARM.pose(HOME)
        target[:3, 3] += [0.1, 0.1, -0.2]
        result = robot.move_linear(target, speed=0.1)
        assert not result.contact and max(distance(result.base_T_tcp, target)) < 2e-4
        assert 2.4 < world.seconds < 4.5 and world.fastest < 0.101
        robot.move_joints(np.array([HOME + 0.05, HOME]), speed=0.1)
        np.testing.assert_array_equal(robot.state().q, HOME)
        robot.open_gripper(0.03)
        assert robot.state().gripper_width_m == pytest.approx(0.03, abs=1e-9)
        assert not robot.grasp(width_m=0.01, force_N=10.0)
        assert robot.state().gripper_width_m == pytest.approx(0.0, abs=1e-9)
        world.place_object(0.02)
        robot.open_gripper(0.05)
        assert not robot.grasp(width_m=0.01, force_N=10.0), "wider than expected"
        robot.open_gripper(0.05)
        assert robot.grasp(width_m=0.02, force_N=10.0)
        with pytest.raises(GraspError, match="between"):
            robot.open_gripper(0.01)
    robot.close()
    with pytest.raises(ConnectionLost):
        robot.state()


def test_what_the_arm_cannot_do_is_refused_and_moves_nothing() -> None:
    robot = SimRobot(TableWorld())
    refuses_what_the_arm_cannot_do(robot)
    with pytest.raises(InputError):
        robot.move_linear(ARM.pose(HOME), speed=0.1, stop_force_N=50.0)
    np.testing.assert_array_equal(robot.state().q, HOME)


def test_contact_stops_a_descent_and_without_a_stop_force_the_arm() -> None:
    robot = SimRobot(TableWorld(table_z=0.35))
    low = ARM.pose(HOME)
    low[2, 3] = 0.3
    result = robot.move_linear(low, speed=0.05, stop_force_N=8.0)
    assert result.contact and 0.345 < result.base_T_tcp[2, 3] < 0.35
    assert robot.state().force_N[2] > 8.0 and robot.state().mode == RobotMode.IDLE
    with pytest.raises(ReflexError, match="met"):
        robot.move_linear(low, speed=0.05)
    assert robot.state().mode == RobotMode.REFLEX
    with pytest.raises(ReflexError):
        robot.move_joints(HOME, speed=0.1)
    robot.recover()
    robot.move_joints(HOME, speed=0.1)


def test_stop_ends_a_motion() -> None:
    class Stopper(TableWorld):
        robot: SimRobot

        def step(self, hand: Hand) -> Contact:
            self.robot.stop()
            return super().step(hand)

    world = Stopper()
    world.robot = robot = SimRobot(world, SimRobotConfig(dt=2e-3))
    with pytest.raises(MotionError, match="stopped"):
        robot.move_joints(HOME + 0.2, speed=0.1)
    assert 0.0 < np.abs(robot.state().q - HOME).max() < 0.01
    assert robot.state().mode == RobotMode.IDLE


# Both together.


def test_a_chain_is_placed(twin: CableTwin) -> None:
    result = execute(SafeRobot(SimRobot(twin), LIMITS), MIDDLE)
    assert result.outcome == PickPlaceOutcome.PLACED
    assert result.width_after_lift_m == pytest.approx(2 * CONFIG.chain.radius, abs=2e-4)
    look = twin.look()
    placed = np.linalg.norm(look.beads[:, :2] - MIDDLE.place_xy, axis=1)
    assert placed.min() < 6e-3 and 35 < placed.argmin() < 55
    assert look.held == () and np.abs(lengths(look.beads) - 1.0).max() < 0.05
    assert look.beads[[0, -1], 0] == pytest.approx(0.45, abs=0.08), "the ends lag behind"


def test_a_pick_beside_the_chain_misses(twin: CableTwin) -> None:
    action = PickPlaceAction((0.50, 0.0), np.pi / 2, (0.55, 0.05), np.pi / 2)
    result = execute(SafeRobot(SimRobot(twin), LIMITS), action)
    assert result.outcome == PickPlaceOutcome.MISSED_GRASP and result.max_force_N == 0.0
    assert np.abs(twin.look().beads - ALONG_Y).max() < 1e-3


def test_a_finger_on_the_chain_is_felt_and_misses(twin: CableTwin) -> None:
    action = PickPlaceAction((0.45 + 0.0215, 0.0), np.pi / 2, (0.55, 0.05), np.pi / 2)
    result = execute(SafeRobot(SimRobot(twin), LIMITS), action)
    assert result.outcome == PickPlaceOutcome.MISSED_GRASP
    assert 8.0 < result.max_force_N < 12.0
    assert np.abs(twin.look().beads - ALONG_Y).max() < 2e-3


# The simulated camera.


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_shows_the_mask(twin: CableTwin, seed: int) -> None:
    twin.toss(seed)
    frame = SimCamera(twin.look, seed=seed).read()
    assert frame.rgb.shape == (720, 1280, 3) and frame.depth_m is None
    mask = segment_cable(CONFIG.view.rectify(frame.rgb, sim_calibration()))
    assert mask_iou(mask, CableMaskGoal().mask(twin.look().beads)) > 0.9


def test_a_picture_depends_on_scene_and_seed_only(twin: CableTwin) -> None:
    one, same, other = (SimCamera(twin.look, seed=seed).read().rgb for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert 0 < np.abs(one.astype(int) - other).mean() < 10
    clean = SimCameraConfig(
        noise=0.0, grain=0.0, blur_px=0.0, shade=0.0, size=(640, 360), focal_px=305.0
    )
    camera = SimCamera(twin.look, config=clean)
    np.testing.assert_array_equal(camera.read().rgb, camera.read().rgb)
    assert segment_cable(
        CONFIG.view.rectify(camera.read().rgb, sim_calibration(camera=clean))
    ).any()
    camera.close()
    with pytest.raises(CameraError, match="closed"):
        camera.read()


def test_the_calibration_is_that_of_the_camera(twin: CableTwin) -> None:
    """Where the middle of a bead is drawn is where the calibration says that it is."""
    camera, calibration = SimCamera(twin.look), sim_calibration()
    look = twin.look()
    drawn = camera._project(look.beads, look.base_T_tcp)[0]
    np.testing.assert_allclose(calibration.base_to_pixel(look.beads[:, :2]), drawn, atol=0.01)
    back = calibration.pixel_to_base(drawn)
    np.testing.assert_allclose(back[:, :2], look.beads[:, :2], atol=2e-5)
    np.testing.assert_allclose(back[:, 2], FOAM[2])


def test_a_camera_at_the_foam_sees_nothing(twin: CableTwin) -> None:
    pose = ARM.pose(HOME)
    pose[2, 3] = 0.02
    twin.step(Hand(pose, np.zeros(3), 0.08, False, 1e-3))
    with pytest.raises(CameraError, match="home pose"):
        SimCamera(twin.look).read()
    twin.step(Hand(ARM.pose(HOME), np.zeros(3), 0.08, False, 1e-3))
