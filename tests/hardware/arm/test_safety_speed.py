"""The hand's speed, descents in small steps, stops that hold, and arguments that are none."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import pytorch_kinematics as pk
import torch
from fixtures.panda_urdf import poses
from fixtures.places import ROOT
from fixtures.safety_fuzzing import fuzz
from fixtures.safety_spy import ARM, HOME, joints_at, pose
from fixtures.watched_sim import DT, Watched, watched

from hardware import RobotError
from hardware.arm.joint_path import corner_cuts, path_pieces
from hardware.arm.limits import SafetyLimits, dense_path
from hardware.arm.panda import DQ_MAX
from hardware.arm.path_speed import MAX_TURN_SPEED, OVERSHOOT, fitting_share
from hardware.arm.sinking import LEVEL
from hardware.arm.table_plane import TablePlane
from warp_deform.errors import InputError

URDF_FILE = ROOT / "warp_deform" / "robots" / "assets" / "panda" / "panda.urdf"
FLAT = SafetyLimits(table=TablePlane(0.0))
FAST = replace(FLAT, max_joint_speed=0.2)


def speeds(world: Watched) -> tuple[float, float]:
    """The TCP's greatest speed, and downwards, by the other kinematics [m/s]."""
    velocity = np.diff(poses(np.array(world.q))[:, :3, 3], axis=0) / DT
    return float(np.linalg.norm(velocity, axis=1).max()), float(-velocity[:, 2].min())


# The hand's speed.


def test_the_other_kinematics_are_the_urdfs() -> None:
    """By pytorch-kinematics on the robot's file; without it the fuzz would prove nothing."""
    chain = pk.build_serial_chain_from_urdf(
        URDF_FILE.read_bytes(), "panda_hand_tcp", "panda_link0"
    ).to(dtype=torch.float64)
    q = HOME + np.random.default_rng(0).uniform(-0.5, 0.5, (20, 7))
    theirs = chain.forward_kinematics(torch.from_numpy(q)).get_matrix().numpy()
    np.testing.assert_allclose(poses(q), theirs, atol=1e-6)
    np.testing.assert_allclose(ARM.poses(q), theirs, atol=1e-6)


def test_home_and_joint_motions_keep_the_hands_speed_and_say_so() -> None:
    """At a share of 0.2 the hand went at up to 0.59 m/s, and home at 0.27."""
    robot, world = watched(FAST, q=joints_at(pose(0.6, 0.25, 0.3)))
    told = robot.home()
    fastest, down = speeds(world)
    assert 0.07 < fastest <= FLAT.max_speed and down <= FLAT.max_descent_speed
    assert told.slowed and told.speed < 0.2
    for goal in (joints_at(pose(0.55, -0.3, 0.1)), HOME, joints_at(pose(0.45, 0.3, 0.15))):
        world.q.clear()
        start = world.robot.state().q
        count = int(np.ceil(np.abs(goal - start).max() / 0.4))
        way = start + np.arange(1, count + 1)[:, None] / count * (goal - start)
        told = robot.move_joints(way, speed=0.2)
        fastest, down = speeds(world)
        assert fastest <= FLAT.max_speed and down <= FLAT.max_descent_speed and told.slowed
    robot, _ = watched(FAST)
    assert not robot.move_joints(HOME + 0.01, speed=0.005).slowed


def test_a_share_that_fits_is_the_greatest_that_does() -> None:
    """Along one joint the hand's speed is the lever times the joint's."""
    way = dense_path(np.array([HOME, HOME + 0.5 * np.eye(7)[0]]))
    lever = np.hypot(*ARM.pose(HOME)[:2, 3])
    share = fitting_share(way, ARM.poses(way), max_speed=0.1, max_turn_speed=np.inf)
    assert share * OVERSHOOT * DQ_MAX[0] * lever == pytest.approx(0.1, rel=1e-3)
    turning = fitting_share(way, ARM.poses(way), max_speed=np.inf, max_turn_speed=0.5)
    assert turning * OVERSHOOT * DQ_MAX[0] == pytest.approx(0.5, rel=1e-3)
    assert fitting_share(way[:1].repeat(2, 0), ARM.poses(way[:2]), max_speed=0.1) == np.inf


def test_a_rounded_corner_is_checked_on_its_inner_side() -> None:
    """The vendor's planner cuts corners: what it cuts through has to be within the limits, too."""
    corner = HOME + np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    path = np.array([HOME, corner, corner + np.array([0.03, 0.1, 0, 0, 0, 0, 0])])
    (cut,) = corner_cuts(path)
    half = 0.5 * np.arctan2(0.03, 0.1)
    middle = cut.mean(axis=0)
    # The circle leaves the corner by at most 0.02 rad, and its chord by as much again.
    assert 0.0 < np.linalg.norm(corner - middle) <= 0.02 * (1.0 + np.cos(half)) + 1e-9
    assert corner_cuts(np.array([HOME, corner, HOME])) == [], "the arm rests there"


def test_waypoints_that_return_are_no_step() -> None:
    """To and fro by less than a standstill is a waypoint on its start, which stalls the vendor."""
    e = np.eye(7)[0]
    assert path_pieces(HOME, np.array([HOME + 1.5e-3 * e, HOME + 0.6e-3 * e])) == []
    way = HOME + np.array([[0.1], [0.1015], [0.1006]]) * e
    ((_, piece),) = path_pieces(HOME, way)
    np.testing.assert_array_equal(piece, way[-1:])


# Descents in small steps.


@pytest.mark.parametrize("step", [2e-4, 9.5e-4])
def test_small_steps_down_need_a_stop_force(step: float) -> None:
    """44 steps of 0.95 mm went from 51 to 9 mm."""
    robot, world = watched(FAST, q=joints_at(pose(0.5, 0.0, 0.051)))
    with pytest.raises(RobotError, match=r"^contact_height_m"):
        for k in range(1, 300):
            robot.move_linear(pose(0.5, 0.0, 0.051 - step * k), speed=0.05)
    assert float(world.robot.state().base_T_tcp[2, 3]) >= FLAT.contact_height_m - LEVEL - 1e-4


def test_motions_with_a_stop_force_in_between_make_small_steps_no_better() -> None:
    robot, world = watched(FAST, q=joints_at(pose(0.5, 0.0, 0.03)))
    here = 0.03
    with pytest.raises(RobotError, match=r"^contact_height_m"):
        for _ in range(5):
            here -= 6e-4
            robot.move_linear(pose(0.5, 0.0, here), speed=0.05)
            robot.move_linear(pose(0.5, 0.001, here), speed=0.05, stop_force_N=8.0)
            robot.move_linear(pose(0.5, 0.0, here), speed=0.05, stop_force_N=8.0)
    robot.move_linear(pose(0.5, 0.0, here + 2e-3), speed=0.05)  # risen again, all is well
    robot.move_linear(pose(0.5, 0.0, here + 1.2e-3), speed=0.05)
    assert world.robot.state().base_T_tcp[2, 3] > 0.025


def test_a_hand_that_has_sagged_goes_down_slowly() -> None:
    """A level line from 0.9 mm too high is no descent, and yet keeps the speed of one."""
    robot, world = watched(FAST, q=joints_at(pose(0.5, 0.0, 0.2)))
    told = robot.move_linear(pose(0.5, 0.0005, 0.1991), speed=0.1)
    assert told.slowed_to == pytest.approx(0.05 * np.hypot(0.5, 0.9) / 0.9, rel=0.05)
    assert speeds(world)[1] <= 0.05
    assert robot.move_linear(pose(0.5, 0.1, 0.1991), speed=0.1).slowed_to is None


# What the page says.


def test_the_page_names_the_limits_as_they_are() -> None:
    page = (ROOT / "docs" / "hardware.md").read_text()
    cells = [row.split(" | ") for row in re.findall(r"^\| (.+) \|$", page, re.M)]
    rows = {row[0]: row[1] for row in cells if len(row) == 3}
    expected = {
        "workspace": [*FLAT.x, *FLAT.y, FLAT.margin_m],
        "floor": [FLAT.min_tcp_height_m],
        "corners of the open fingers and the hand": [3],
        "ceiling": [FLAT.max_z_m],
        "lean of the hand": [FLAT.max_tilt_rad, round(np.degrees(FLAT.max_tilt_rad))],
        "speed of the TCP": [FLAT.max_speed],
        "speed of the TCP downwards": [FLAT.max_descent_speed],
        "turning of the hand": [MAX_TURN_SPEED],
        "joint speed between poses": [FLAT.max_joint_speed, 0.2],
        "joint positions": [100 * FLAT.joint_margin],
        "joint step": [FLAT.max_joint_step_rad],
        "force of the fingers": [FLAT.max_grasp_force_N],
        "arrival, distance": [1e3 * FLAT.arrival_tolerance_m],
        "arrival, angle": [round(np.degrees(FLAT.arrival_tolerance_rad))],
        "below 0.05 m above the table": [FLAT.max_contact_force_N],
    }
    for what, numbers in expected.items():
        assert [float(n) for n in re.findall(r"-?\d+\.?\d*", rows[what])] == pytest.approx(numbers)
    assert FLAT.contact_height_m == 0.05
    with pytest.raises(InputError):
        replace(FLAT, max_joint_speed=0.21)


# All of it, at random.


def test_hundreds_of_commands_keep_all_written_limits() -> None:
    """`benchmarks/safety_fuzz.py` gives thousands."""
    tally = fuzz(350, seed=1, dt=4e-3)
    assert tally.findings == {}, tally.examples
    assert tally.moved > 50 and tally.refused > 150
    assert tally.worst["TCP speed"] > 0.8 and tally.worst["TCP speed downwards"] > 0.8
