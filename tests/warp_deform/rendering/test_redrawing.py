"""Frames of films: only what changed is drawn again, and what nobody can see is not drawn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
from fixtures.drawable_samples import NO_BODIES, NO_PARTICLES, drawables

from warp_deform.collecting.workers import single_threaded
from warp_deform.rendering.camera import look_at
from warp_deform.rendering.meshes import Mesh, box_mesh
from warp_deform.rendering.perspective import Perspective
from warp_deform.rendering.scene_view import STUDIO, ArmMeshes, SceneView
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds.loop import worlds_for

SIZE = (150, 266)
GREY = (120, 130, 140)


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    with single_threaded():
        yield


def _ball() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    return Mesh(np.array(ball.vertices, np.float32), np.array(ball.faces, np.int32), GREY)


def test_what_encloses_a_volume_is_closed() -> None:
    ball = _ball()
    box = Mesh(*box_mesh((0.1, 0.2, 0.3)), GREY)
    corners = ball.vertices[ball.faces].reshape(-1, 3)  # as in an STL file, without shared corners
    soup = Mesh(corners, np.arange(len(corners)).reshape(-1, 3), GREY)
    away = Mesh(ball.vertices + np.float32(3.0), ball.faces, GREY)
    two = Mesh(
        np.concatenate([box.vertices, away.vertices]),
        np.concatenate([box.faces, len(box.vertices) + away.faces]),
        GREY,
    )
    assert ball.closed and box.closed and soup.closed and away.closed and two.closed


def test_what_has_a_hole_or_looks_inwards_is_not_closed() -> None:
    ball = _ball()
    assert not Mesh(ball.vertices, ball.faces[1:], GREY).closed  # a hole
    assert not Mesh(ball.vertices, ball.faces[:, ::-1], GREY).closed  # inside out
    turned = ball.faces.copy()
    turned[7] = turned[7, ::-1]
    assert not Mesh(ball.vertices, turned, GREY).closed  # one face looks inwards
    assert not Mesh(ball.vertices, np.concatenate([ball.faces, ball.faces[:1]]), GREY).closed
    sheet = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    assert not Mesh(sheet, np.array([[0, 1, 2]]), GREY).closed
    assert not Mesh(sheet, np.array([[0, 1, 2], [0, 2, 1]]), GREY).closed  # encloses nothing


def _picture(mesh: Mesh) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 0.0, 0.15
    camera = look_at((0.9, -0.3, 0.6), (0.5, 0.0, 0.15), size=SIZE, vertical_fov=0.5)
    [seen] = Perspective(look=STUDIO).render(
        drawables(), NO_PARTICLES, NO_BODIES, [camera], [(mesh.vertices, mesh.faces, pose, GREY)]
    )
    return seen.depth


def test_the_inside_is_seen_through_a_hole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Culling of closed surfaces changes next to nothing, and takes no wall from an open one."""
    ball = _ball()
    middle = ball.vertices[ball.faces].mean(axis=1)
    towards = np.array([0.4, -0.3, 0.45]) / np.linalg.norm([0.4, -0.3, 0.45])
    bowl = Mesh(ball.vertices, ball.faces[middle @ towards < 0.05], GREY)
    assert not bowl.closed
    culled, open_ = _picture(ball), _picture(bowl)
    deeper = open_ > culled + 0.01
    assert np.count_nonzero(deeper) > 500, "through the hole one sees the far wall"
    # nearly everywhere that is the wall: the floor behind is farther away than the ball is large
    assert (open_[deeper] < culled[deeper] + 0.2).mean() > 0.95
    with monkeypatch.context() as without:
        without.setattr(Mesh, "closed", False)
        assert np.count_nonzero(_picture(ball) != culled) <= 3
    with monkeypatch.context() as wrongly:
        wrongly.setattr(Mesh, "closed", True)  # what the rule keeps from happening
        assert np.count_nonzero(_picture(bowl)[deeper] != open_[deeper]) > 500


@pytest.mark.parametrize("name", ["cable-shape", "fabric-cover", "bag-items-1"])
@pytest.mark.parametrize("seed", [0, 1])
def test_frames_of_an_action_are_those_drawn_from_scratch(name: str, seed: int) -> None:
    """Some frames left out at random; the arm moves, stands still, is away; views change."""
    rng = np.random.default_rng(seed)
    task = find_task(name)
    worlds = worlds_for(task.name, "ur5")
    worlds.reset({0: 10 + seed}, goals={})
    start = worlds.episodes[0]
    pick = rng.uniform([0.35, -0.3], [0.65, 0.3])
    if len(start.snapshot.particle_q):
        pick = start.snapshot.particle_q[rng.integers(len(start.snapshot.particle_q))][:2]
    action = np.array([*pick, 0, *rng.uniform([0.35, -0.3], [0.65, 0.3]), 0, task.stages[0].lift])
    report = worlds.step({0: action}, record=0.1)[0]
    frames = report.frames
    assert frames is not None and len(frames.times) > 10
    joints = np.concatenate([q for q in report.joints if q is not None])
    robot = worlds.robot
    arm = ArmMeshes(robot.meshes())
    shown = worlds.episodes[0].drawables
    cameras = [None, look_at((1.2, 0.6, 0.7), (0.5, 0.0, 0.1), size=SIZE, vertical_fov=0.6)]
    views = [SceneView(SIZE, camera=camera) for camera in cameras]
    skipped = shaded = 0
    for k in np.flatnonzero(rng.random(len(frames.times)) < 0.35):
        q = joints[min(int(k * len(joints) / len(frames.times)), len(joints) - 1)]
        links = [] if rng.random() < 0.15 else arm.at(robot.link_poses(q))
        state = shown, frames.particle_q[k], frames.body_q[k], links
        for view in views:
            if rng.random() < 0.3:
                skipped += 1
                continue
            frame = view.render(*state)
            if rng.random() < 0.3:
                assert (view.render(*state) == frame).all()
            fresh = SceneView(SIZE, camera=view.camera).render(*state)
            assert (frame == fresh).all(), (k, np.abs(frame.astype(int) - fresh).max())
            shaded += 1
    assert skipped > 0 and shaded > 3


def test_forgetting_draws_the_same_frame_whole() -> None:
    view = SceneView(SIZE)
    shown, centre = drawables(spheres=[0.05]), np.array([[0.5, 0.0, 0.1]])
    first = view.render(shown, centre, NO_BODIES)
    moved = view.render(shown, centre + 0.03, NO_BODIES)
    view.forget()
    assert (view.render(shown, centre + 0.03, NO_BODIES) == moved).all()
    assert (view.render(shown, centre, NO_BODIES) == first).all() and (first != moved).any()
