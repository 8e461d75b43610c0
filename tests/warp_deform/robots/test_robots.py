"""Robot arms: inverse against forward kinematics, reach, continuity, bits, meshes, licences."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from warp_deform.errors import InputError
from warp_deform.robots import ROBOTS, Robot, robot
from warp_deform.robots.description import ArmConfig
from warp_deform.robots.unwrap import unwrap

NAMES = tuple(ROBOTS)
BITS = ("q", "reached", "position_error", "rotation_error")


@pytest.fixture(params=NAMES)
def arm(request: pytest.FixtureRequest) -> Robot:
    return robot(request.param)


def poses_in_reach(arm: Robot, count: int, *, seed: int) -> np.ndarray:
    """Return tip-down poses in reach at heights 0-0.4 m, within 70 degrees of forward, any yaw."""
    rng = np.random.default_rng(seed)
    poses = np.empty((count, 4))
    for row in poses:
        z = rng.uniform(0.0, 0.4)
        radius, turn = rng.uniform(*arm.reach(z)), np.radians(rng.uniform(-70.0, 70.0))
        row[:] = radius * np.cos(turn), radius * np.sin(turn), z, rng.uniform(-np.pi, np.pi)
    return poses


def pose_errors(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [m] and angles [rad] between poses (N, 4, 4), by another library."""
    turn = Rotation.from_matrix(a[:, :3, :3]) * Rotation.from_matrix(b[:, :3, :3]).inv()
    return np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1), turn.magnitude()


def urdf_forward(arm: Robot, q: np.ndarray) -> np.ndarray:
    """Return root_T_flange by multiplying the joints of the URDF, independently of torch."""
    source = ET.fromstring(arm.urdf)
    joint_of_child = {joint.find("child").get("link"): joint for joint in source.findall("joint")}
    joints, link = [], arm.flange
    while link in joint_of_child and link != {"ur5": "base_link"}.get(arm.name):
        joints.insert(0, joint_of_child[link])
        link = joint_of_child[link].find("parent").get("link")
    pose, values = np.eye(4), iter(q)
    for joint in joints:
        origin, step = joint.find("origin"), np.eye(4)
        step[:3, 3] = [float(v) for v in origin.get("xyz").split()]
        step[:3, :3] = Rotation.from_euler(
            "xyz", [float(v) for v in origin.get("rpy").split()]
        ).as_matrix()
        if joint.get("type") == "revolute":
            axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
            step[:3, :3] = step[:3, :3] @ Rotation.from_rotvec(axis * next(values)).as_matrix()
        pose = pose @ step
    return pose


def test_one_instance_per_name_and_a_clear_error() -> None:
    assert robot("ur5") is robot("ur5")
    with pytest.raises(InputError, match="ur5, panda"):
        robot("ur10")


def test_import_is_light() -> None:
    code = (
        "import sys; import warp_deform.robots as r; r.robot('panda').reach(0.1);"
        "sys.exit(any(m in sys.modules for m in ('torch', 'trimesh', 'pytorch_kinematics')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_forward_agrees_with_the_urdf(arm: Robot) -> None:
    rng = np.random.default_rng(0)
    offset = {"ur5": 0.099, "panda": 0.1034}[arm.name]
    mount, tip = np.eye(4), np.eye(4)
    mount[:3, :3] = Rotation.from_euler("z", np.pi if arm.name == "ur5" else 0.0).as_matrix()
    tip[2, 3] = offset
    q = rng.uniform(-2.0, 2.0, (20, arm.dof))
    expected = np.array([mount @ urdf_forward(arm, row) @ tip for row in q])
    np.testing.assert_allclose(arm.forward(q), expected, atol=1e-6)


def test_home_points_down_over_the_table(arm: Robot) -> None:
    pose = arm.forward(arm.home_q)[0]
    np.testing.assert_allclose(pose[:3, 2], [0.0, 0.0, -1.0], atol=1e-6)
    assert 0.25 < pose[0, 3] < 0.75 and 0.25 < pose[2, 3] < 0.6
    with pytest.raises(ValueError, match="read-only"):
        arm.home_q[0] = 1.0


def test_top_down_matrices(arm: Robot) -> None:
    pose = arm.top_down([0.5, -0.1, 0.2, 0.3])[0]
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(pose[:3, 0], [np.cos(0.3), np.sin(0.3), 0.0])
    np.testing.assert_allclose(pose[:, 3], [0.5, -0.1, 0.2, 1.0])


@pytest.mark.parametrize("config", ROBOTS.values(), ids=NAMES)
def test_closed_form_postures_are_exact(config: ArmConfig) -> None:
    # So that the iteration has nothing to do, and the lengths in the module are those of the URDF.
    arm = robot(config.name)
    poses = poses_in_reach(arm, 200, seed=11)
    position, rotation = pose_errors(arm.forward(config.posture(poses)), arm.top_down(poses))
    assert position.max() < 1e-6 and rotation.max() < 1e-6


def test_top_down_poses_are_met(arm: Robot) -> None:
    poses = poses_in_reach(arm, 1000, seed=1)
    result = arm.solve_top_down(poses)
    position, rotation = pose_errors(arm.forward(result.q), arm.top_down(poses))
    assert result.reached.mean() >= 0.995
    assert ((position <= 1e-3) & (rotation <= 1e-2)).mean() >= 0.995
    np.testing.assert_allclose(position, result.position_error, atol=1e-9)
    np.testing.assert_allclose(rotation, result.rotation_error, atol=1e-6)
    assert position[result.reached].max() <= 1e-4 and rotation[result.reached].max() <= 1e-3
    assert (result.q >= arm.q_min).all() and (result.q <= arm.q_max).all()


def test_tilted_poses_are_met(arm: Robot) -> None:
    rng = np.random.default_rng(2)
    radius, turn = rng.uniform(0.40, 0.65, 400), rng.uniform(-1.0, 1.0, 400)
    x, y, z = radius * np.cos(turn), radius * np.sin(turn), rng.uniform(0.05, 0.25, 400)
    poses = arm.top_down(np.column_stack([x, y, z, rng.uniform(-1.5, 1.5, 400)]))
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.25, (400, 3))).as_matrix()
    poses[:, :3, :3] = tilt @ poses[:, :3, :3]
    result = arm.inverse(poses)
    position, rotation = pose_errors(arm.forward(result.q), poses)
    assert ((position <= 1e-3) & (rotation <= 1e-2)).mean() >= 0.995
    assert result.reached.mean() >= 0.995


def test_poses_of_random_joint_positions(arm: Robot) -> None:
    rng = np.random.default_rng(3)
    low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
    q = rng.uniform(low, high, (200, arm.dof))
    assert arm.inverse(arm.forward(q)).reached.mean() >= 0.93
    near = np.clip(q + rng.normal(0.0, 0.1, q.shape), low, high)
    assert arm.inverse(arm.forward(q), seed=near).reached.mean() >= 0.97


def test_every_yaw_is_reached_within_the_reach_table(arm: Robot) -> None:
    rng = np.random.default_rng(4)
    yaws = np.radians(np.arange(0.0, 360.0, 10.0))
    poses = []
    for z in np.concatenate([[0.0, 0.01, 0.7], rng.uniform(0.0, 0.7, 30)]):
        smallest, largest = arm.reach(z)
        for radius in (smallest, *rng.uniform(smallest, largest, 2), largest):
            turn = np.radians(rng.uniform(-70.0, 70.0))
            x, y = radius * np.cos(turn), radius * np.sin(turn)
            poses += [(x, y, z, yaw) for yaw in yaws]
    assert arm.solve_top_down(np.array(poses)).reached.all()


def test_reach_table_is_tight_outside(arm: Robot) -> None:
    for z in np.linspace(0.0, 0.7, 15):
        radius = arm.reach(z)[1] + 0.01
        poses = [(radius, 0.0, z, yaw) for yaw in np.linspace(-3.0, 3.0, 13)]
        assert not arm.solve_top_down(poses).reached.all(), z


@pytest.mark.parametrize(
    ("name", "height", "share"),
    [
        *(("ur5", 0.01, 1.0), ("ur5", 0.3, 0.94), ("ur5", 0.4, 0.84)),
        *(("panda", 0.01, 0.92), ("panda", 0.3, 0.90), ("panda", 0.4, 0.84)),
    ],
)
def test_share_of_the_table_in_reach(name: str, height: float, share: float) -> None:
    x, y = np.meshgrid(np.linspace(0.25, 0.75, 51), np.linspace(-0.5, 0.5, 101))
    smallest, largest = robot(name).reach(height)
    radius = np.hypot(x, y)
    assert share <= ((smallest <= radius) & (radius <= largest)).mean() <= share + 0.05


def test_reach_is_empty_outside_the_table(arm: Robot) -> None:
    assert arm.reach(-0.1) == arm.reach(2.0) == (np.inf, 0.0)


def test_hover_height(arm: Robot) -> None:
    assert arm.hover_height(0.5, 0.0) == 0.30
    assert arm.hover_height(0.5, 0.0, wanted=0.1) == 0.1
    low = arm.hover_height(0.70, -0.45)
    high = arm.hover_height(0.5, -0.2, wanted=5.0)
    assert 0.30 < high < 0.7
    assert arm.solve_top_down((0.5, -0.2, high, 0.0)).reached.all()
    assert not arm.solve_top_down((0.5, -0.2, high + 0.02, 0.0)).reached.any()
    if arm.name == "ur5":
        assert 0.05 < low < 0.30
        assert arm.solve_top_down((0.70, -0.45, low, 0.0)).reached.all()
        assert not arm.solve_top_down((0.70, -0.45, low + 0.02, 0.0)).reached.any()
    else:
        assert low == 0.0 and not arm.solve_top_down((0.70, -0.45, low, 0.0)).reached.any()
    assert arm.hover_height(2.0, 0.0) == 0.0


def test_unreachable_is_an_outcome(arm: Robot) -> None:
    poses = [(0.5, 0.0, 0.1, 0.0), (1.5, 0.0, 0.1, 0.0), (0.5, 0.0, 3.0, 1.0), (0.0, 0.0, 0.1, 0.0)]
    for result in (arm.solve_top_down(poses), arm.inverse(arm.top_down(poses))):
        assert result.reached.tolist()[:3] == [True, False, False]
        assert np.isfinite(result.q).all()
        assert (result.position_error[1:3] > 0.1).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e9])
def test_values_that_are_no_lengths_raise(arm: Robot, bad: float) -> None:
    pose = np.array([[0.5, 0.0, 0.1, 0.0], [0.5, bad, 0.1, 0.0]])
    for call in (arm.solve_top_down, arm.top_down, arm.trajectory):
        with pytest.raises(InputError, match="row 1"):
            call(pose)
    with pytest.raises(InputError):
        arm.inverse(np.full((1, 4, 4), bad))
    with pytest.raises(InputError):
        arm.forward(np.full(arm.dof, bad))
    with pytest.raises(InputError):
        arm.solve_top_down(pose[:1], seed=np.full(arm.dof, bad))


def test_bad_shapes_raise(arm: Robot) -> None:
    for call, value in (
        (arm.forward, np.zeros((2, 3))),
        (arm.solve_top_down, np.zeros((2, 3))),
        (arm.solve_top_down, "a pose"),
        (arm.inverse, np.zeros((4, 3))),
        (arm.inverse, 2.0 * np.eye(4)),
        (arm.inverse, np.diag([1.0, 1.0, -1.0, 1.0])),
    ):
        with pytest.raises(InputError):
            call(value)
    path = np.tile([0.5, 0.0, 0.1, 0.0], (4, 1))
    for lengths in ([3], [5, -1], [4, 0]):
        with pytest.raises(InputError, match="lengths"):
            arm.trajectory(path, lengths=lengths)
    with pytest.raises(InputError, match="seed"):
        arm.solve_top_down(path, seed=np.zeros((3, arm.dof)))
    for height in (np.nan, -1.0):
        with pytest.raises(InputError):
            arm.hover_height(0.5, 0.0, wanted=height)
    with pytest.raises(InputError):
        arm.reach(np.nan)


def test_empty_batches(arm: Robot) -> None:
    for result in (
        arm.solve_top_down(np.zeros((0, 4))),
        arm.trajectory(np.zeros((0, 4))),
        arm.inverse(np.zeros((0, 4, 4))),
    ):
        assert result.q.shape == (0, arm.dof) and result.reached.shape == (0,)
    assert arm.forward(np.zeros((0, arm.dof))).shape == (0, 4, 4)


@given(
    st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 4), min_size=1, max_size=3),
    st.sampled_from(NAMES),
)
@settings(derandomize=True, deadline=None, max_examples=25)
def test_any_pose_gets_a_finite_verified_answer(poses: list, name: str) -> None:
    arm = robot(name)
    result = arm.solve_top_down(poses)
    position, _ = pose_errors(arm.forward(result.q), arm.top_down(poses))
    assert np.isfinite(result.q).all()
    assert (position[result.reached] <= 1e-4).all()


def test_a_pose_has_the_same_bits_in_any_batch(arm: Robot) -> None:
    rng = np.random.default_rng(5)
    poses = poses_in_reach(arm, 120, seed=6)
    poses[::40, 0] += 1.0  # some out of reach
    tilted = arm.top_down(poses)
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.3, (120, 3))).as_matrix()
    tilted[:, :3, :3] = tilt @ tilted[:, :3, :3]
    q = rng.uniform(-1.0, 1.0, (120, arm.dof))
    top_down, general = arm.solve_top_down(poses), arm.inverse(tilted)
    forward, links = arm.forward(q), arm.link_poses(q)
    for first, count in ((0, 1), (7, 1), (3, 2), (11, 5), (50, 8), (20, 17), (31, 64)):
        rows = slice(first, first + count)
        for whole, part in (
            (top_down, arm.solve_top_down(poses[rows])),
            (general, arm.inverse(tilted[rows])),
        ):
            for field in BITS:
                expected = getattr(whole, field)[rows]
                assert getattr(part, field).tobytes() == expected.tobytes(), (first, count, field)
        assert arm.forward(q[rows]).tobytes() == forward[rows].tobytes()
        for name, pose in arm.link_poses(q[rows]).items():
            assert pose.tobytes() == links[name][rows].tobytes()


def pick_and_place(arm: Robot, rng: np.random.Generator) -> np.ndarray:
    """Return 10 waypoints of one action: down, up, a line in five pieces, down, up."""
    ends = np.empty((2, 4))
    for row in ends:
        radius, turn = rng.uniform(0.30, 0.75), np.radians(rng.uniform(-60.0, 60.0))
        yaw = rng.uniform(-np.pi, np.pi)
        row[:] = radius * np.cos(turn), radius * np.sin(turn), 0.1, yaw
    carry = np.linspace(*ends, 6)
    low = ends * [1.0, 1.0, 0.0, 1.0] + [0.0, 0.0, 0.01, 0.0]
    return np.array([carry[0], low[0], *carry, low[1], carry[-1]])


def test_trajectories_are_continuous(arm: Robot) -> None:
    rng, unwound, checked = np.random.default_rng(7), 0, 0
    for _ in range(40):
        path = pick_and_place(arm, rng)
        result = arm.trajectory(path)
        # The Panda's elbow leaves the arm's plane where its last joint cannot turn far enough.
        free = result.reached & ((np.abs(result.q[:, 2]) < 1e-4) | (arm.name == "ur5"))
        pair = free[1:] & free[:-1]
        step = np.abs(np.diff(result.q, axis=0))
        moved = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
        turned = np.abs(np.diff(path[:, 3]))
        # A joint moves with the tip: no elbow flip.
        assert (step[pair, :-1].max(axis=1) < 12.0 * moved[pair] + 0.01).all()
        # The wrist follows the yaw, but for a whole turn where it would meet its limit.
        whole = step[:, -1] > np.pi
        assert (step[pair & ~whole, -1] < (12.0 * moved + turned)[pair & ~whole] + 0.01).all()
        unwound, checked = unwound + whole.sum(), checked + pair.sum()
        if arm.name == "ur5":
            assert (result.q[:, 2] >= 0.0).all(), "the elbow stays up"
    assert checked > 250
    assert unwound <= {"ur5": 0, "panda": 10}[arm.name]


def test_a_full_turn_of_yaw_is_followed(arm: Robot) -> None:
    yaw = np.linspace(0.0, 2.0 * np.pi, 60)
    path = np.column_stack([np.full(60, 0.5), np.zeros(60), np.full(60, 0.05), yaw])
    result = arm.trajectory(path)
    assert result.reached.all()
    wrist = np.diff(result.q[:, -1])
    unwinding = np.abs(wrist) > 1.0
    assert unwinding.sum() == {"ur5": 0, "panda": 1}[arm.name]
    assert np.ptp(wrist[~unwinding]) < 1.0


def test_a_path_alone_equals_the_path_in_a_batch(arm: Robot) -> None:
    rng = np.random.default_rng(9)
    paths = [pick_and_place(arm, rng) for _ in range(5)]
    together = arm.trajectory(np.concatenate(paths), lengths=[10] * 5)
    for i, path in enumerate(paths):
        alone = arm.trajectory(path)
        for field in BITS:
            assert getattr(together, field)[10 * i : 10 * i + 10].tobytes() == (
                getattr(alone, field).tobytes()
            )


def test_seed_chooses_the_turn_of_the_last_joint() -> None:
    arm, pose = robot("ur5"), [0.5, 0.0, 0.1, 0.0]
    near, far = arm.home_q.copy(), arm.home_q.copy()
    far[-1] += 2.0 * np.pi
    first, second = arm.solve_top_down(pose, seed=near), arm.solve_top_down(pose, seed=far)
    assert first.reached.all() and second.reached.all()
    assert second.q[0, -1] - first.q[0, -1] == pytest.approx(2.0 * np.pi)


@given(st.lists(st.floats(-20.0, 20.0), min_size=1, max_size=12), st.integers(1, 3))
@settings(derandomize=True, deadline=None, max_examples=60)
def test_unwrap_keeps_angles_and_limits(angles: list, paths: int) -> None:
    angle = np.array(angles * paths)
    starts = np.arange(paths) * len(angles)
    for limit in (7.0, 2.9):
        result = unwrap(angle, starts, np.zeros(paths), -limit, limit)
        turns = (result - angle) / (2.0 * np.pi)
        np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
        possible = np.abs(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi) <= limit
        assert (np.abs(result[possible]) <= limit + 1e-9).all()
        assert (np.abs(result) <= max(limit, np.pi) + 1e-9).all()


def test_unwrap_without_limits_never_jumps() -> None:
    angle = np.remainder(np.linspace(0.0, 20.0, 200), 2.0 * np.pi)
    result = unwrap(angle, np.array([0]), np.array([0.0]), -100.0, 100.0)
    np.testing.assert_allclose(result, np.linspace(0.0, 20.0, 200), atol=1e-9)


def test_no_link_is_below_the_table_when_picking(arm: Robot) -> None:
    poses = [p for p in poses_in_reach(arm, 40, seed=10) if np.hypot(*p[:2]) > 0.3]
    poses = np.array(poses) * [1.0, 1.0, 0.0, 1.0] + [0.0, 0.0, 0.012, 0.0]
    result = arm.solve_top_down(poses)
    links = arm.link_poses(result.q)
    for link, pose, mesh in arm.meshes():
        vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        height = np.einsum("nj,vj->nv", links[link][:, 2, :3], vertices) + links[link][:, 2, 3:4]
        assert height[result.reached].min() > -0.005, link
