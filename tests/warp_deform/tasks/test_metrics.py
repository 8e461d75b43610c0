"""Scores: bounds, symmetries and known values."""

from __future__ import annotations

import doctest
import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import ConvexHull

from warp_deform.tasks import demonstrators, ground_truth, metrics, target_shapes

quick = settings(derandomize=True, deadline=None, max_examples=60)
coordinate = st.floats(-1.0, 1.0, allow_subnormal=False)
clouds = arrays(float, st.tuples(st.integers(1, 40), st.just(2)), elements=coordinate)
masks = arrays(bool, (6, 5))
poses = arrays(float, 3, elements=st.floats(-10.0, 10.0, allow_subnormal=False))


@pytest.mark.parametrize("module", [metrics, target_shapes, ground_truth, demonstrators])
def test_doctests(module) -> None:
    assert doctest.testmod(module, extraglobs={"np": np}).failed == 0


@pytest.mark.parametrize("n", [3, 4, 32, 200])
def test_hull_of_a_regular_polygon(n: int) -> None:
    angle = 2 * np.pi * np.arange(n) / n
    ring = 0.075 * np.column_stack([np.cos(angle), np.sin(angle)]) + [0.5, -0.3]
    inside = ring * 0.5 + [0.25, -0.15]
    expected = n / 2 * 0.075**2 * math.sin(2 * math.pi / n)
    order = np.random.default_rng(0).permutation(2 * n)
    assert metrics.hull_area(np.concatenate([ring, inside])[order]) == pytest.approx(expected)


def test_hull_agrees_with_qhull() -> None:
    rng = np.random.default_rng(1)
    for n in (4, 10, 32):
        points = rng.normal(size=(n, 2))
        assert metrics.hull_area(points) == pytest.approx(ConvexHull(points).volume)


@given(clouds)
@quick
def test_hull_is_bounded_by_the_box_and_does_not_depend_on_order_or_motion(points) -> None:
    area = metrics.hull_area(points)
    assert 0 <= area <= np.prod(np.ptp(points, axis=0)) + 1e-12
    assert metrics.hull_area(points[::-1]) == pytest.approx(area, abs=1e-12)
    moved = target_shapes.to_world(points, np.array([0.5, -0.2, 0.7]))
    assert metrics.hull_area(moved) == pytest.approx(area, abs=1e-9)


@given(clouds, coordinate, coordinate)
@quick
def test_hull_grows_with_another_point(points, x, y) -> None:
    more = np.concatenate([points, [[x, y]]])
    assert metrics.hull_area(more) >= metrics.hull_area(points) - 1e-12


@pytest.mark.parametrize("n", [0, 1, 2, 3, 24])
def test_degenerate_hulls_span_nothing(n: int) -> None:
    t = np.arange(n)[:, None]
    assert metrics.hull_area(t * [0.1, 0.3]) == pytest.approx(0, abs=1e-12)
    assert metrics.hull_area(np.ones((n, 2))) == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_never_score(bad: float) -> None:
    points = np.random.default_rng(0).uniform(size=(8, 2))
    points[3, 1] = bad
    assert math.isnan(metrics.hull_area(points))
    assert not metrics.hull_area(points) >= 0.75
    assert metrics.share_in_zone(points, points[:3], 10.0) == pytest.approx(7 / 8)


@given(clouds, clouds, st.floats(0.0, 3.0))
@quick
def test_share_in_zone_is_a_share_and_grows_with_tolerance(points, targets, tolerance) -> None:
    share = metrics.share_in_zone(points, targets, tolerance)
    assert 0 <= share <= metrics.share_in_zone(points, targets, 2 * tolerance) <= 1
    assert metrics.share_in_zone(targets, targets, 1e-9) == 1
    assert metrics.share_in_zone(points, targets[::-1], tolerance) == share


def test_share_in_zone_counts_below_the_tolerance_only() -> None:
    points = np.array([[0.0, 0.0], [0.5, 0.0], [0.75, 0.0]])
    assert metrics.share_in_zone(points, np.zeros((1, 2)), 0.5) == pytest.approx(1 / 3)


@given(masks, masks)
@quick
def test_masks(a, b) -> None:
    iou = metrics.mask_iou(a, b)
    assert 0 <= iou <= 1
    assert iou == metrics.mask_iou(b, a)
    assert metrics.mask_iou(a, a) == float(a.any())
    assert iou <= metrics.coverage(a, b) <= 1


@given(poses, poses, st.integers(-3, 3))
@quick
def test_pose_error_is_symmetric_and_periodic(pose, target, turns) -> None:
    distance, turn = metrics.pose_error(pose, target)
    assert distance >= 0
    assert 0 <= turn <= np.pi
    assert metrics.pose_error(target, pose) == pytest.approx((distance, turn), abs=1e-9)
    again = metrics.pose_error(pose + np.array([0, 0, 2 * np.pi * turns]), target)
    assert again == pytest.approx((distance, turn), abs=1e-9)
    assert metrics.pose_error(pose, pose) == (0, 0)


def test_chords_tell_how_a_chain_is_bent_wherever_it_lies() -> None:
    straight = np.column_stack([np.zeros(90), np.arange(90) * 5e-3])
    error = functools.partial(metrics.chord_error, links=15, spacing=5e-3)
    assert error(straight[:, ::-1] + 0.1, straight) == pytest.approx(0.0, abs=1e-12)
    kinked = straight.copy()
    kinked[45:] -= [0.0, 0.075]  # the second half lies back by as long as a chord
    assert error(kinked, straight) == pytest.approx(15 / 75), "15 of 75 chords bridge the kink"
    arc = np.linspace(0.0, np.pi, 90)
    bow = np.column_stack([np.cos(arc), np.sin(arc)]) * 89 * 5e-3 / np.pi
    assert error(bow, straight) > 0.01 and error(straight, bow) == error(bow, straight)
