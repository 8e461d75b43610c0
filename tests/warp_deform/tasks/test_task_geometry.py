"""Where tasks put things: free space on the table, and the shapes that cables are laid along."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warp_deform.errors import InputError
from warp_deform.objects.cable import CableConfig, cable_ring
from warp_deform.rendering.pixels import PIXEL_SIZE, SHAPE, world_to_pixel
from warp_deform.tasks.free_space import FreeSpace, NoFreeSpace
from warp_deform.tasks.target_shapes import Shape, chain_yaw, sample_shape


def test_free_space_never_gives_a_covered_or_unreachable_pixel() -> None:
    zone = np.array([[[0.3, -0.4, 0], [0.4, -0.4, 0], [0.4, 0.1, 0], [0.3, 0.1, 0]]])
    space = FreeSpace((0.3, 0.8)).occupy_disc((0.5, 0.2), 0.12).occupy_quads(zone)
    rng = np.random.default_rng(0)
    for size in (0.002, 0.04):
        for _ in range(200):
            x, y, yaw = space.sample(rng, size, size)
            assert space.free[tuple(world_to_pixel(np.array([x, y])))]
            assert math.hypot(x - 0.5, y - 0.2) >= max(0.12, 0.12 + size / 2 - PIXEL_SIZE)
            assert not (0.3 <= x <= 0.4 and -0.4 <= y <= 0.1)
            assert 0.3 + size / 2 <= math.hypot(x, y) <= 0.8 - size / 2
            assert 0 <= yaw < 2 * np.pi


def test_occupying_leaves_the_space_itself_alone() -> None:
    space = FreeSpace()
    triangle = np.array([[0.4, 0.0], [0.6, 0.0], [0.4, 0.2]])
    taken = space.occupy_polygon(triangle)
    assert space.free.all()
    assert np.count_nonzero(~taken.free) == pytest.approx(0.02 / PIXEL_SIZE**2, rel=0.08)
    assert not taken.free[tuple(world_to_pixel(np.array([0.45, 0.05])))]
    assert taken.free[tuple(world_to_pixel(np.array([0.55, 0.15])))]


def test_free_space_samples_every_free_pixel_alike() -> None:
    cover = np.ones(SHAPE, bool)
    cover[10:12, 20:23] = False
    rng = np.random.default_rng(0)
    places = [FreeSpace(None, cover).sample(rng, 0, 0)[:2] for _ in range(1200)]
    pixels, counts = np.unique(world_to_pixel(np.array(places)), axis=0, return_counts=True)
    assert len(pixels) == 6
    assert counts.min() > 150


def test_a_full_table_is_a_typed_error() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(NoFreeSpace, match="smaller or fewer"):
        FreeSpace().occupy_disc((0.5, 0.0), 2.0).sample(rng, 0.01, 0.01)
    with pytest.raises(NoFreeSpace):
        FreeSpace().sample(rng, 0.4, 0.4)


@pytest.mark.parametrize("reach", [(0.5, 0.4), (-0.1, 0.5), (0.1, math.nan), (0.1, math.inf)])
def test_free_space_rejects_a_bad_reach(reach) -> None:
    with pytest.raises(InputError):
        FreeSpace(reach)


@pytest.mark.parametrize("sides", [1, 2, 3, 4])
def test_targets_lie_on_the_outline_one_spacing_apart(sides: int) -> None:
    cable = CableConfig()
    for cutoff in range(25) if sides == 2 else range(4, 21):
        shape = Shape(sides, cutoff)
        targets, outline = shape.targets(cable), shape.outline(cable)
        assert targets.shape == (24, 2)
        lengths = np.linalg.norm(np.diff(outline, axis=0), axis=1)
        assert lengths.sum() == pytest.approx(cable.length)
        gaps = np.linalg.norm(np.diff(targets, axis=0), axis=1)
        at_corner = gaps < cable.spacing * (1 - 1e-9)
        assert np.count_nonzero(at_corner) <= sides - 1
        assert gaps.max() <= cable.spacing * (1 + 1e-9)
        assert gaps.min() >= 0.7 * cable.spacing
        assert np.linalg.norm(targets, axis=1).max() <= cable.length / 2
        for target in targets:  # distance to the nearest side
            along = np.diff(outline, axis=0)
            share = np.sum((target - outline[:-1]) * along, axis=1)
            share = np.clip(share / np.maximum(lengths**2, 1e-12), 0, 1)
            nearest = outline[:-1] + share[:, None] * along
            assert np.linalg.norm(nearest - target, axis=1).min() < 1e-9


def test_targets_of_the_straight_line() -> None:
    cable = CableConfig()
    i = np.arange(24)
    x = cable.length / 2 - cable.spacing * i - 0.005
    assert Shape(1, 0).targets(cable) == pytest.approx(np.column_stack([x, 0 * i]))


def test_targets_of_two_sides_follow_the_published_rule() -> None:
    cable, c = CableConfig(), 9
    d, x, y = cable.spacing, cable.length * 9 / 24, cable.length * 15 / 24
    expected = [
        (x / 2 - d * i - 0.005, -y / 2) if i < c else (-x / 2, -y / 2 + d * (i - c) + 0.005)
        for i in range(24)
    ]
    assert Shape(2, c).targets(cable) == pytest.approx(np.array(expected))


def test_shapes_cover_every_number_of_sides_and_cutoff() -> None:
    rng = np.random.default_rng(0)
    drawn = [sample_shape(rng, (2, 3, 4), 24) for _ in range(3000)]
    assert {s.cutoff for s in drawn if s.sides == 2} == set(range(25))
    for sides in (3, 4):
        assert {s.cutoff for s in drawn if s.sides == sides} == set(range(4, 21))
    counts = [sum(s.sides == n for s in drawn) for n in (2, 3, 4)]
    assert min(counts) > 900
    with pytest.raises(InputError):
        Shape(5, 3)


def test_chain_yaw_is_the_tangent() -> None:
    ring = cable_ring(CableConfig(beads=40, closed=True), (0.5, 0.0))
    angle = 2 * np.pi * np.arange(40) / 40
    turn = chain_yaw(ring, closed=True) - (angle + np.pi / 2)
    assert np.cos(turn) == pytest.approx(1)
    line = np.arange(5)[:, None] * [1.0, -1.0]
    assert chain_yaw(line, closed=False) == pytest.approx(-np.pi / 4)
