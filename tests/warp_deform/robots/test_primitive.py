"""The pick-and-place primitive without physics: what a tip meets, and when it is where."""

from __future__ import annotations

from dataclasses import replace

import newton
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from warp_deform.objects import BoxConfig, CableConfig, add_box, add_cable, cable_line, l_block
from warp_deform.robots import robot
from warp_deform.robots.primitive import (
    Grasp,
    PrimitiveConfig,
    Stage,
    approach,
    carry,
    find_grasp,
    solve_joints,
)
from warp_deform.support.quaternion import quat_from_yaw

CONFIG = PrimitiveConfig()
STAGE = Stage(lift=0.04, speed=0.15)
CABLE = CableConfig(beads=4)
LINE = cable_line(CABLE, (0.5, 0.0), (0.6, 0.0))
REACH = CABLE.visual_radius + CONFIG.tip_radius
HELD = Grasp(0.012, np.array([0.002, 0.0, -0.007]), np.array([0.0, 0.0, 0.0, 1.0]), particle=1)
angles = st.floats(-np.pi, np.pi)


def scene(*boxes: BoxConfig):
    """A cable of four beads and boxes."""
    builder = newton.ModelBuilder()
    return [
        add_cable(builder, CABLE, LINE),
        *(add_box(builder, box, (0.0, 0.0, 0.0)) for box in boxes),
    ]


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> list[float]:
    return [x, y, z, *quat_from_yaw(yaw)]


def pick(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    return np.array([x, y, yaw])


def carry_to(place_yaw: float, *, start_yaw: float = 0.0, place=(0.5, 0.2), floor=0.012):
    action = np.array([0.5, 0.0, start_yaw, *place, place_yaw, 0.04])
    return carry(action, HELD, STAGE, floor, 0.30, CONFIG)


def test_the_tip_meets_the_highest_bead_within_its_reach() -> None:
    beads = LINE.copy()
    beads[2] += [-CABLE.spacing + 0.004, 0.0, 0.010]  # lies on bead 1, 4 mm beside it
    grasp = find_grasp(pick(*beads[1, :2]), scene(), beads, np.zeros((0, 7)), CONFIG)
    assert grasp is not None and grasp.particle == 2 and grasp.body is None
    assert grasp.height == pytest.approx(beads[2, 2] + np.sqrt(REACH**2 - 0.004**2))


@pytest.mark.parametrize(("share", "met"), [(0.99, True), (1.01, False)])
def test_beads_are_met_up_to_their_visual_radius_and_the_tips(share: float, met: bool) -> None:
    at = pick(LINE[0, 0], LINE[0, 1] + share * REACH)
    grasp = find_grasp(at, scene(), LINE, np.zeros((0, 7)), CONFIG)
    assert (grasp is not None) == met


def test_the_tip_meets_a_box_before_the_bead_under_it() -> None:
    bodies = np.array([pose(0.5, 0.0, 0.05)])
    grasp = find_grasp(pick(0.5, 0.0), scene(BoxConfig()), LINE, bodies, CONFIG)
    assert grasp is not None and grasp.body == 0 and grasp.particle is None
    assert grasp.height == pytest.approx(0.07)


def test_the_tip_falls_through_the_notch_of_the_l_block() -> None:
    objects, bodies = scene(l_block())[1:], np.array([pose(0.5, 0.0, 0.02, np.pi / 2)])
    # turned by a quarter, the legs point to +y and -x
    for x, y, met in ((0.5, 0.06, True), (0.44, 0.0, True), (0.45, 0.05, False)):
        grasp = find_grasp(pick(x, y), objects, np.zeros((0, 3)), bodies, CONFIG)
        assert (grasp is not None) == met, (x, y)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(pick_yaw=angles, body_yaw=angles)
def test_a_grasp_holds_things_where_they_are(pick_yaw: float, body_yaw: float) -> None:
    # tip pose times offset and turn is the pose of the centre of mass
    objects, bodies = scene(l_block())[1:], np.array([pose(0.5, 0.0, 0.02, body_yaw)])
    grasp = find_grasp(pick(0.502, 0.001, pick_yaw), objects, np.zeros((0, 3)), bodies, CONFIG)
    assert grasp is not None
    tip, body = Rotation.from_rotvec([0, 0, pick_yaw]), Rotation.from_quat(bodies[0, 3:])
    centre = bodies[0, :3] + body.apply(l_block().inertia()[0])
    held = np.add([0.502, 0.001, grasp.height], tip.apply(grasp.offset))
    np.testing.assert_allclose(held, centre, atol=1e-12)
    assert (tip * Rotation.from_quat(grasp.turn) * body.inv()).magnitude() < 1e-9


def test_motions_take_the_time_that_their_speed_says() -> None:
    motion = approach(np.array([0.5, 0.0, 0.3, 0.0]), pick(0.5, 0.4), 0.3, 0.01, CONFIG)
    assert motion.seconds == pytest.approx((0.4 + 0.29) / CONFIG.unloaded_speed)
    steps = np.linalg.norm(np.diff(motion.waypoints[:, :3], axis=0), axis=1)
    assert steps.max() <= CONFIG.spacing + 1e-12
    motion, path = carry_to(0.0)
    loaded = (0.028 + 0.2 + 0.028) / 0.15
    assert path.times[-1] == pytest.approx(loaded + CONFIG.dwell)
    assert path.lower == pytest.approx((loaded - 0.028 / 0.15, loaded))
    assert motion.seconds == pytest.approx(path.times[-1] + 0.288 / CONFIG.unloaded_speed)
    np.testing.assert_array_equal(path.positions[-1], path.positions[-2])


@settings(derandomize=True, deadline=None, max_examples=60)
@given(start=st.floats(-2 * np.pi, 2 * np.pi), goal=angles, place=angles, far=st.booleans())
def test_the_tip_turns_the_short_way_and_never_too_fast(
    start: float, goal: float, place: float, far: bool
) -> None:
    approached = approach(np.array([0.5, 0.0, 0.3, start]), pick(0.5, 0.1, goal), 0.3, 0.0, CONFIG)
    assert approached.waypoints[-1, 3] == goal
    assert np.cos(approached.waypoints[0, 3] - start) == pytest.approx(1.0)
    _, path = carry_to(place, start_yaw=goal, place=(0.5, 0.2) if far else (0.5, 0.0))
    assert path.rotations is not None
    turns = Rotation.from_quat(path.rotations)
    assert (turns[-1] * Rotation.from_rotvec([0, 0, -place])).magnitude() < 1e-6
    for times, yaw in (
        (approached.times, approached.waypoints[:, 3]),
        (path.times, np.unwrap(turns.as_euler("xyz")[:, 2])),
    ):
        assert abs(yaw[-1] - yaw[0]) <= np.pi + 1e-9
        assert np.abs(np.diff(yaw)).max() <= CONFIG.turn_spacing + 1e-9
        assert (np.abs(np.diff(yaw)) <= CONFIG.turn_speed * np.diff(times) + 1e-9).all()


def test_what_would_be_pressed_into_the_table_is_lowered_no_further_than_the_lift() -> None:
    _, path = carry_to(0.0, floor=0.06)
    assert path.positions[-1, 2] == 0.04
    assert path.lower is not None and path.lower[0] == path.lower[1]


@given(st.floats(0.0, 0.4), st.floats(0.04, 0.4), st.floats(0.0, 0.3))
def test_a_box_is_never_carried_below_where_it_was_taken(height, lift, floor) -> None:
    """A box that lies on a bag would be pressed through it."""
    box = replace(HELD, height=height, particle=None, body=0)
    action = np.array([0.5, 0.0, 0.0, 0.5, 0.2, 0.0, lift])
    motion, path = carry(action, box, STAGE, floor, 0.30, CONFIG)
    lowered, _ = path.lower
    carried = path.positions[path.times <= lowered]
    assert carried[:, 2].min() == pytest.approx(height)
    assert carried[:, 2].max() == pytest.approx(max(height, lift))
    assert path.positions[-1, 2] == pytest.approx(min(floor, max(height, lift)))
    assert motion.seconds >= path.times[-1]
    bead = replace(HELD, height=height)
    _, path = carry(action, bead, STAGE, floor, 0.30, CONFIG)
    assert path.positions[path.times <= path.lower[0]][-1, 2] == pytest.approx(lift)


def test_a_vertex_of_a_fabric_ends_its_descent_on_what_it_meets_only_where_it_is_to() -> None:
    action = np.array([0.5, 0.0, 0.0, 0.5, 0.2, 0.0, 0.04])
    grasp = replace(HELD, sheet=True)
    for meets in (False, True):
        config = PrimitiveConfig(sheet_meets=meets, sheet_release=0.006)
        _, path = carry(action, grasp, STAGE, 0.004, 0.30, config)
        assert (path.lower is not None) is meets
        assert path.positions[-1, 2] == pytest.approx(0.01)


def test_the_arm_goes_on_from_where_it_is_unless_its_wrist_is_wound_up() -> None:
    arm, rng = robot("ur5"), np.random.default_rng(0)
    posture, tip, unwound = arm.home_q, np.array([0.5, 0.0, 0.2, 0.0]), 0
    for k in range(30):
        x, y, place_x, place_y = rng.uniform([0.45, -0.2] * 2, [0.6, 0.2] * 2)
        yaw, place_yaw = rng.uniform(-np.pi, np.pi, 2)
        towards = approach(tip, pick(x, y, yaw), 0.2, 0.012, CONFIG)
        action = np.array([x, y, yaw, place_x, place_y, place_yaw, 0.04])
        onwards, _ = carry(action, HELD, STAGE, 0.012, 0.2, CONFIG)
        for motion in (towards, onwards):
            [q] = solve_joints(arm, [motion], [posture])
            assert q is not None
            jump = q[0] - posture
            if k and np.abs(jump).max() > 0.01:
                unwound += 1
                np.testing.assert_allclose(jump[:5], 0.0, atol=0.01)
                last = q[:, 5] - jump[5]
                assert last.min() < arm.q_min[5] or last.max() > arm.q_max[5]
            posture = q[-1]
        tip = onwards.waypoints[-1]
    assert unwound < 10
