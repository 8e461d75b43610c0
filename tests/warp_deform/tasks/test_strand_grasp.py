"""The tangent of curved cables, and crossings."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from fixtures.cable_drawings import curve, draw, lone
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_deform.errors import InputError
from warp_deform.tasks import strand_grasp
from warp_deform.tasks.strand_grasp import find_strand_grasp, map_direction, wrap_half_turn


def crossing(rng: np.random.Generator, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Mask of two slightly bent strands that cross at `low` to `high` degrees, and where."""
    angle, turn = rng.uniform(-np.pi, np.pi), math.radians(rng.uniform(low, high))
    centre = np.array([80.0, 160.0]) + rng.uniform(-2, 2, 2)
    t = np.linspace(-65, 65, 200)
    strands = []
    for a, bend in zip((angle, angle + turn), rng.uniform(-0.006, 0.006, 2), strict=True):
        along, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
        strands.append(centre + np.outer(t, along) + np.outer(0.5 * bend * t * t, across))
    return draw(strands, rng.uniform(2.2, 4.5)), centre


@pytest.fixture
def widths_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask's typical width is the same at all picks of it, and most of what a grasp costs."""
    measure, known = strand_grasp._typical_width, {}

    def typical(mask: np.ndarray, pixels: np.ndarray, radius: float) -> float:
        key = mask.tobytes(), radius
        if key not in known:
            known[key] = measure(mask, pixels, radius)
        return known[key]

    monkeypatch.setattr(strand_grasp, "_typical_width", typical)


@pytest.mark.usefixtures("widths_measured_once")
def test_tangent_on_curved_cables(record_property: Callable[[str, object], None]) -> None:
    rng = np.random.default_rng(0)
    errors, feet, flagged = [], [], 0
    for _ in range(60):
        points, angles = curve(rng)
        width = rng.uniform(2.2, 4.5)
        if not lone(points, width):
            continue
        mask = draw([points], width)
        for i in rng.integers(60, 3940, 8):
            column, row = np.round(points[i])
            grasp = find_strand_grasp(mask, (row, column))
            assert grasp is not None
            nearest = int(np.argmin(np.linalg.norm(points - (column, row), axis=1)))
            errors.append(abs(wrap_half_turn(grasp.tangent - angles[nearest])))
            feet.append(np.linalg.norm(points - grasp.point[::-1], axis=1).min())
            flagged += grasp.crossing
            assert abs(wrap_half_turn(grasp.opening - grasp.tangent)) == pytest.approx(np.pi / 2)
    degrees = np.degrees(errors)
    record_property("median error of the angle [deg]", round(float(np.median(degrees)), 3))
    assert len(degrees) > 200
    assert np.median(degrees) < 0.5
    assert np.percentile(degrees, 95) < 2.0
    assert np.median(feet) < 0.1
    assert flagged <= 0.01 * len(degrees)


@pytest.mark.parametrize(
    ("low", "high", "share"), [(20.0, 30.0, 0.9), (30.0, 60.0, 0.95), (60.0, 90.0, 0.98)]
)
def test_crossings_are_flagged(low: float, high: float, share: float) -> None:
    rng = np.random.default_rng(1)
    flagged = 0
    for _ in range(50):
        mask, centre = crossing(rng, low, high)
        column, row = centre + rng.normal(0.0, 1.0, 2)
        grasp = find_strand_grasp(mask, (row, column))
        flagged += grasp is not None and grasp.crossing
    assert flagged >= share * 50


def test_a_neighbouring_strand_does_not_turn_the_tangent() -> None:
    t = np.linspace(-60, 60, 200)
    strand = np.stack([80 + 0 * t, 160 + t], axis=1)
    beside = strand + np.array([7.0, 0.0])
    grasp = find_strand_grasp(draw([strand, beside], 3.0), (160, 80))
    assert grasp is not None and not grasp.crossing
    assert abs(abs(grasp.tangent) - np.pi / 2) < 0.01


def test_a_blob_is_a_crossing() -> None:
    mask = np.hypot(*(np.indices((320, 160)) - np.array([160, 80])[:, None, None])) < 8
    grasp = find_strand_grasp(mask, (160, 80))
    assert grasp is not None and grasp.crossing and grasp.spread > 0.5


def test_a_pick_beside_the_cable_moves_to_it_or_finds_nothing() -> None:
    mask = draw([np.array([[20.0, 160.0], [140.0, 160.0]])], 3.0)
    near = find_strand_grasp(mask, (165, 80))
    assert near is not None and near.point[0] == pytest.approx(160.0, abs=0.1)
    assert abs(near.tangent) < 1e-6
    assert find_strand_grasp(mask, (180, 80)) is None
    assert find_strand_grasp(np.zeros((320, 160), bool), (180, 80)) is None


@pytest.mark.parametrize("pick", [(-1, 5), (320, 5), (5, 160), (float("nan"), 5)])
def test_a_pick_outside_of_the_mask(pick: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="outside"):
        find_strand_grasp(np.ones((320, 160), bool), pick)


def test_at_the_rim_of_the_picture() -> None:
    mask = draw([np.array([[-20.0, 100.0], [30.0, 100.0]])], 3.0)
    grasp = find_strand_grasp(mask, (100, 0))
    assert grasp is not None and abs(grasp.tangent) < 0.02


@settings(derandomize=True, deadline=None, max_examples=300)
@given(angle=st.floats(-20.0, 20.0))
def test_wrapping_keeps_the_line(angle: float) -> None:
    wrapped = wrap_half_turn(angle)
    assert -np.pi / 2 < wrapped <= np.pi / 2
    assert abs(math.sin(wrapped - angle)) < 1e-9


def test_directions_through_a_jacobian() -> None:
    assert map_direction(0.3, np.eye(2)) == pytest.approx(0.3)
    assert map_direction(0.3, np.diag([1.0, -1.0])) == pytest.approx(-0.3)  # mirrored
    assert map_direction(0.0, np.array([[0.0, 1.0], [2.0, 0.0]])) == pytest.approx(np.pi / 2)
