"""Pinhole pictures and their fusion against closed forms and the top-down picture."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from fixtures.drawable_samples import NO_BODIES, NO_PARTICLES, TABLE, drawables
from fixtures.drawable_samples import scene as sample_scene

from warp_deform.errors import InputError
from warp_deform.rendering.camera import Camera, look_at, paper_cameras
from warp_deform.rendering.fusion import fuse
from warp_deform.rendering.meshes import box_mesh
from warp_deform.rendering.normals import crease_normals
from warp_deform.rendering.perspective import Perspective
from warp_deform.rendering.pixels import PIXEL_SIZE
from warp_deform.rendering.scene_view import STUDIO, SceneView
from warp_deform.rendering.topdown import TopDown


@pytest.fixture(scope="module")
def scene():
    return sample_scene()


def test_depth_of_the_table_is_exact():
    [camera, *_] = paper_cameras()
    [view] = Perspective().render(drawables(), NO_PARTICLES, NO_BODIES, [camera])
    row, column = np.nonzero(view.segmentation == 1)
    K, pose = camera.intrinsics, camera.world_T_camera
    d = np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones(len(row))], -1)
    world = (d * view.depth[row, column, None]) @ pose[:3, :3].T + pose[:3, 3]
    assert len(row) > 50_000
    assert np.abs(world[:, 2]).max() < 1e-6
    assert world[:, 0].min() > 0.2499 and world[:, 0].max() < 0.7501
    # a lit table has about the colour that the networks expect
    assert abs(np.median(view.color[row, column]) - TABLE) <= 4


def test_depth_of_a_sphere_a_rod_and_a_triangle_is_exact():
    camera = look_at((0.9, -0.4, 0.5), (0.5, 0.0, 0.1), size=(240, 320), vertical_fov=0.6)
    centres = np.array([[0.5, 0.0, 0.1], [0.42, 0.06, 0.12]])
    corners = np.array([[0.55, 0.1, 0.0], [0.6, 0.0, 0.05], [0.45, 0.12, 0.15]])
    shown = drawables(spheres=[0.03, 0.02], triangles=[[2, 3, 4]], links=[[0, 1]])
    particle_q = np.concatenate([centres, corners])
    [view] = Perspective(links=True).render(shown, particle_q, NO_BODIES, [camera])
    row, column = np.indices(camera.size, dtype=float)
    K, pose = camera.intrinsics, camera.world_T_camera
    d = np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones_like(row)], -1)
    points = (d * view.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    axis = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    arm = points - centres[0]
    to_rod = np.abs(np.linalg.norm(arm - (arm @ axis)[..., None] * axis, axis=-1) - 0.004)
    to_spheres = np.abs(np.linalg.norm(points[..., None, :] - centres, axis=-1) - [0.03, 0.02])
    first, second, sheet = (view.segmentation == number for number in (4, 5, 6))
    assert min(first.sum(), second.sum(), sheet.sum()) > 300
    assert to_spheres[..., 1][second].max() < 1e-5
    on_sphere = to_spheres[..., 0] < 1e-5
    assert (on_sphere | (to_rod < 1e-5))[first].all()
    assert np.count_nonzero(first & ~on_sphere) > 50
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    assert np.abs((points - corners[0]) @ normal)[sheet].max() < 1e-5


def test_a_triangle_that_passes_behind_the_camera_needs_no_clipping():
    camera = Camera(np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]), np.eye(4), (48, 64))
    # the plane y = 0.1 in the camera's frame, from far behind to far ahead
    corners = np.array([[-50.0, 0.1, -5.0], [50.0, 0.1, -5.0], [0.0, 0.1, 50.0]])
    shown = drawables(triangles=[[0, 1, 2]])
    [view] = Perspective().render(shown, corners, NO_BODIES, [camera])
    rows = np.arange(24, 48)
    expected = np.minimum(0.1 * 50 / (rows - 23.5), 10)
    assert (view.segmentation[24:] == 4).all()
    np.testing.assert_allclose(view.depth[24:], np.broadcast_to(expected[:, None], (24, 64)), 1e-4)


def test_fused_cameras_agree_with_the_top_down_picture(scene):
    shown, particle_q, body_q = scene
    cameras = paper_cameras()
    views = Perspective().render(shown, particle_q, body_q, cameras)
    color, height, segmentation = fuse(
        [v.color for v in views],
        [v.depth for v in views],
        cameras,
        [v.segmentation for v in views],
    )
    assert color.dtype == np.uint8 and height.dtype == np.float32
    images = TopDown().render(shown, particle_q, body_q)
    # away from edges: a window of 5 pixels has no step
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(images.height, 2, "edge"), (5, 5))
    flat = np.ptp(windows, axis=(2, 3)) < 0.004
    gap = np.abs(height - images.height)[flat]
    assert flat.mean() > 0.8
    assert np.quantile(gap, 0.99) < 0.002
    mark = images.segmentation == 17
    inner = mark & (np.roll(mark, 3, 0) & np.roll(mark, -3, 0) & np.roll(mark, 3, 1))
    assert (segmentation[inner & (height > 0)] == 17).mean() > 0.98


def test_fusion_takes_the_highest_point_and_the_mean_colour():
    # straight down from 1 m; a pixel of the camera is 3.125 mm on the table
    K = np.array([[320.0, 0, 80], [0, 320, 160], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
    pose[:3, 3] = 0.5 + PIXEL_SIZE / 2, -PIXEL_SIZE / 2, 1.0
    camera = Camera(K, pose, (320, 160))
    depth = np.full((320, 160), 0.99, np.float32)
    low = np.full((320, 160, 3), 100, np.uint8)
    high = np.full((320, 160, 3), 31, np.uint8)
    raised = depth.copy()
    raised[100, 50] = 0.9
    black = high.copy()
    black[7, 9] = 0
    color, height, _ = fuse([low, black], [depth, raised], [camera, camera])
    seen = height[1:-1, 1:-1]
    assert np.count_nonzero(np.abs(seen - 0.01) > 1e-6) >= 1
    assert height.max() == pytest.approx(0.1, abs=1e-6)
    # 65.5 rounds to even; a black pixel is not counted
    assert (np.unique(color[5:-5, 5:-5]) == [66, 100]).all()


def test_fusion_refuses_pictures_of_another_size():
    camera = paper_cameras()[0]
    color, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32)
    with pytest.raises(InputError, match="depth picture 0"):
        fuse([color], [depth[1:]], [camera])
    with pytest.raises(InputError, match="one picture of each kind"):
        fuse([color, color], [depth], [camera])


def test_perspective_gives_the_same_bits_again(scene):
    first, again = (Perspective().render(*scene, [paper_cameras()[1]])[0] for _ in range(2))
    for name in ("color", "depth", "segmentation"):
        assert (getattr(first, name) == getattr(again, name)).all()


def test_things_cast_shadows_on_the_table():
    camera = paper_cameras()[0]
    shown = drawables(spheres=[0.03])
    renderer = Perspective()
    [near] = renderer.render(shown, np.array([[0.5, 0.0, 0.2]]), NO_BODIES, [camera])
    [far] = renderer.render(shown, np.array([[0.5, 0.0, -5.0]]), NO_BODIES, [camera])
    table = (near.segmentation == 1) & (far.segmentation == 1)
    darker = table & (near.color[..., 0] < 0.8 * far.color[..., 0].astype(float))
    assert 100 < np.count_nonzero(darker) < 0.1 * np.count_nonzero(table)
    assert (near.color[table] <= far.color[table]).all()


def test_scene_view_draws_links_and_robot(scene):
    shown, particle_q, body_q = scene
    view = SceneView((120, 160))
    plain = view.render(shown, particle_q, body_q)
    vertices, faces = box_mesh((0.1, 0.1, 0.4))
    pose = np.eye(4)
    pose[2, 3] = 0.2
    arm = [(vertices, faces, pose, (200, 30, 30))]
    with_arm = view.render(shown, particle_q, body_q, arm)
    assert plain.shape == (120, 160, 3) and plain.dtype == np.uint8
    changed = (plain != with_arm).any(-1).mean()
    assert 0.005 < changed < 0.3
    assert (view.render(shown, particle_q, body_q, arm) == with_arm).all()
    with pytest.raises(InputError, match="mesh poses"):
        view.render(shown, particle_q, body_q, [(vertices, faces, pose * np.nan, (0, 0, 0))])


def test_crease_normals_keep_a_box_sharp_and_a_ball_smooth():
    import trimesh

    vertices, faces = box_mesh((1, 2, 3))
    normals = crease_normals(vertices, faces)
    assert np.isclose(np.abs(normals).max(-1), 1).all()
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = crease_normals(ball.vertices, ball.faces)
    assert ((normals * ball.vertices[ball.faces]).sum(-1) > 0.999).all()


def test_cameras_refuse_nonsense():
    with pytest.raises(InputError, match="finite"):
        Camera(np.eye(3), np.full((4, 4), np.nan))
    with pytest.raises(InputError, match="skew"):
        Camera(np.array([[100.0, 5, 0], [0, 100, 0], [0, 0, 1]]), np.eye(4))
    with pytest.raises(InputError, match="straight above"):
        look_at((0, 0, 1), (0, 0, 0), size=(10, 10), vertical_fov=1.0)


@pytest.mark.parametrize(
    ("supersample", "names"), [(1, ("color", "depth", "segmentation")), (2, ("color",))]
)
def test_what_is_drawn_again_in_parts_has_the_bits_of_a_picture_drawn_whole(
    scene, supersample, names
):
    """Things move, stand still, turn about themselves, leave and come back; cameras alternate."""
    shown, particle_q, body_q = scene
    rng = np.random.default_rng(0)
    vertices, faces = box_mesh((0.1, 0.2, 0.3))
    vertices, pose = np.concatenate([vertices, [[0.3, 0.3, 0.3]]]), np.eye(4)
    faces = np.concatenate([faces, [[0, 7, 8]]])
    camera = look_at((1.3, -0.6, 0.8), (0.45, 0.0, 0.05), size=(150, 203), vertical_fov=0.7)
    options = {"look": STUDIO, "supersample": supersample, "links": True}
    renderer = Perspective(**options)
    other, elsewhere = drawables(spheres=[0.05]), np.array([[0.5, 0.1, 0.1]])
    for step in range(10):
        particle_q, body_q, pose = particle_q.copy(), body_q.copy(), pose.copy()
        if step in (1, 2):
            particle_q[5:9] += rng.normal(0, 0.02, (4, 3))
        if step == 3:
            body_q[:, :3] += [0.05, 0.05, 0.1]
        if step in (4, 5):
            pose[:3, 3] = rng.uniform([0.3, -0.3, 0.1], [0.7, 0.3, 0.5])
        if step == 6:
            pose[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
        if step == 7:
            pose[2, 3] = 0.9
        if step == 8:  # a state that is refused must not be a base for the next picture
            with pytest.raises(InputError, match="not finite"):
                renderer.render(shown, particle_q * np.nan, body_q, [camera])
            renderer.render(other, elsewhere, NO_BODIES, [camera])
        links = [(vertices, faces, pose, (200, 30, 30))]
        scene_now = shown, particle_q, body_q, [camera, paper_cameras()[0]], links
        seen, fresh = renderer.render(*scene_now), Perspective(**options).render(*scene_now)
        for picture, whole in zip(seen, fresh, strict=True):
            for name in names:
                assert (getattr(picture, name) == getattr(whole, name)).all(), (step, name)


def test_a_picture_of_the_same_state_shades_nothing_again(scene, monkeypatch):
    renderer, camera = Perspective(), paper_cameras()[0]
    launched = []
    launch = wp.launch

    def noting(kernel, *arguments, **options):
        launched.append(kernel.key)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", noting)
    first = renderer.render(*scene, [camera])[0].color
    assert launched.count("shade") == 1
    assert (first == renderer.render(*scene, [camera])[0].color).all()
    assert launched.count("shade") == 1
