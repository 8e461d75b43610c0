"""Top-down pictures against closed forms and a ray cast written in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.drawable_samples import NO_BODIES, NO_PARTICLES, TABLE, drawables
from fixtures.drawable_samples import scene as sample_scene
from scipy.spatial.transform import Rotation

from warp_deform.errors import InputError
from warp_deform.rendering.meshes import box_mesh
from warp_deform.rendering.pixels import (
    PIXEL_SIZE,
    SHAPE,
    TABLE_GRID,
    pixel_to_world,
    world_to_pixel,
)
from warp_deform.rendering.topdown import TopDown


@pytest.fixture(scope="module")
def top_down():
    return TopDown()


@pytest.fixture(scope="module")
def scene():
    return sample_scene()


def ray_cast(shown, particle_q, body_q):
    """Height and segmentation by vertical rays through the pixels' points, in double precision."""
    u, v = np.indices(SHAPE)
    xy = pixel_to_world(np.stack([u, v], -1))
    height, segment = np.zeros(SHAPE), np.ones(SHAPE, int)

    def meet(z, where, number):
        better = where & (z > height)
        height[better], segment[better] = z[better], number

    def triangle(a, b, c, number):
        edges = np.array([b - a, c - a])[:, :2].T
        if abs(np.linalg.det(edges)) < 1e-12:
            return
        share = (xy - a[:2]) @ np.linalg.inv(edges).T
        inside = (share >= 0).all(-1) & (share.sum(-1) <= 1)
        meet(a[2] + share @ np.array([b[2] - a[2], c[2] - a[2]]), inside, number)

    for p, r, number in zip(particle_q, shown.sphere_radius, shown.sphere_segment, strict=False):
        square = r**2 - ((xy - p[:2]) ** 2).sum(-1)
        meet(p[2] + np.sqrt(np.maximum(square, 0)), square > 0, number)
    for q, half, number in zip(body_q, shown.box_half, shown.box_segment, strict=True):
        vertices, faces = box_mesh(tuple(2 * half))
        vertices = Rotation.from_quat(q[3:]).apply(vertices) + q[:3]
        for face in faces:
            triangle(*vertices[face], number)
    for corners, number in zip(shown.quad_corners, shown.quad_segment, strict=True):
        triangle(*corners[[0, 1, 2]], number)
        triangle(*corners[[0, 2, 3]], number)
    for face, number in zip(shown.triangle_particle, shown.triangle_segment, strict=True):
        triangle(*particle_q[face], number)
    return height, segment


def test_top_down_agrees_with_a_ray_cast(top_down, scene):
    images = top_down.render(*scene)
    height, segment = ray_cast(*scene)
    same = images.segmentation == segment
    assert np.count_nonzero(~same) <= 2
    assert np.abs(images.height - height)[same].max() < 1e-5
    assert set(np.unique(segment)) == {1, *range(4, 19)}


def test_empty_table_is_what_the_networks_expect(top_down):
    images = top_down.render(drawables(), NO_PARTICLES, NO_BODIES)
    assert images.color.shape == (320, 160, 3) and images.color.dtype == np.uint8
    assert images.height.dtype == np.float32 and images.segmentation.dtype == np.uint8
    assert (images.color == TABLE).all()
    assert not images.height.any() and (images.segmentation == 1).all()


def test_pixels_and_points_undo_each_other():
    pixels = np.stack(np.indices(SHAPE), -1).reshape(-1, 2)
    assert (world_to_pixel(pixel_to_world(pixels)) == pixels).all()
    shifted = pixel_to_world(pixels) + 0.49 * PIXEL_SIZE
    assert (world_to_pixel(shifted) == pixels).all()


def test_what_is_out_of_view_comes_to_its_edge() -> None:
    inside = np.random.default_rng(0).uniform((0.25, -0.5), (0.7468, 0.4968), (100, 2))
    assert np.array_equal(TABLE_GRID.in_view(inside), inside)
    far = np.array([[0.1, 0.0], [0.9, 0.9], [0.2477, -0.0161], [0.5, -2.0]])
    pixels = TABLE_GRID.to_pixel(TABLE_GRID.in_view(far))
    assert ((pixels >= 0) & (pixels < SHAPE)).all()
    assert pixels[1].tolist() == [319, 159] and pixels[0, 1] == pixels[2, 1] == 0


@pytest.mark.parametrize("pixel", [(0, 0), (319, 159), (160, 80), (37, 101)])
def test_a_sphere_is_centred_on_its_pixel(top_down, pixel):
    x, y = pixel_to_world(np.array(pixel))
    images = top_down.render(drawables(spheres=[0.01]), np.array([[x, y, 0.01]]), NO_BODIES)
    assert np.unravel_index(images.height.argmax(), SHAPE) == pixel
    assert images.height[pixel] == pytest.approx(0.02, abs=1e-7)
    padded = np.pad(images.height, 5)
    window = padded[pixel[0] : pixel[0] + 11, pixel[1] : pixel[1] + 11]
    if min(pixel) > 5 and pixel[0] < 314 and pixel[1] < 154:
        np.testing.assert_allclose(window, window[::-1, ::-1], atol=1e-5)
        np.testing.assert_allclose(window, window.T, atol=1e-5)


def test_a_level_face_has_its_own_colour_and_only_its_edge_is_blended(top_down):
    low, high = pixel_to_world(np.array([100, 50])), pixel_to_world(np.array([120, 90]))
    # the edges pass through pixels' centres
    mark = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    corners = np.column_stack([mark, np.full(4, 0.002)])
    shown = drawables(quads=[corners])
    images = top_down.render(shown, NO_PARTICLES, NO_BODIES)
    own = shown.palette[4]
    assert (images.color[101:120, 51:90] == own).all()
    outside = np.ones(SHAPE, bool)
    outside[100:121, 50:91] = False
    assert (images.color[outside] == TABLE).all()
    # a pixel cut in half: samples on the edge belong to the mark, so it gets three quarters
    blend = 0.75 * own.astype(float) + 0.25 * TABLE
    np.testing.assert_allclose(images.color[110, 50], blend, atol=1)
    # never blended
    assert set(np.unique(images.segmentation)) == {1, 4}
    assert set(np.unique(images.height)) == {np.float32(0), np.float32(0.002)}


def test_top_down_gives_the_same_bits_again(scene):
    first, again = (TopDown().render(*scene) for _ in range(2))
    for name in ("color", "height", "segmentation"):
        assert (getattr(first, name) == getattr(again, name)).all()


def test_pictures_do_not_change_when_the_next_is_drawn(top_down, scene):
    shown, particle_q, body_q = scene
    first = top_down.render(shown, particle_q, body_q)
    copy = first.height.copy()
    top_down.render(shown, particle_q + np.array([0.05, 0, 0]), body_q)
    assert (first.height == copy).all()


def test_a_broken_state_is_refused(top_down, scene):
    shown, particle_q, body_q = scene
    with pytest.raises(InputError, match="not finite"):
        top_down.render(shown, np.where(particle_q > 0.5, np.nan, particle_q), body_q)
    with pytest.raises(InputError, match="13 particle entries, fewer"):
        top_down.render(shown, particle_q[:-1], body_q)
    with pytest.raises(InputError, match="body"):
        top_down.render(shown, particle_q, body_q[:-1])


def test_one_drawable_may_be_replaced(top_down):
    shown = drawables(spheres=[0.01])
    grown = replace(shown, sphere_radius=np.array([0.02], np.float32))
    q = np.array([[0.5, 0.0, 0.02]])
    assert top_down.render(shown, q, NO_BODIES).height.max() == pytest.approx(0.03, abs=1e-6)
    assert top_down.render(grown, q, NO_BODIES).height.max() == pytest.approx(0.04, abs=1e-6)
