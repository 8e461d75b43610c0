"""The tangent of curved cables, crossings, and the mask they are found in."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from fixtures.cable_drawings import coverage, curve, draw, lone
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.vision.segmentation import SegmentationConfig, SegmentationError, segment_cable
from warp_deform.errors import InputError
from warp_deform.tasks import strand_grasp
from warp_deform.tasks.metrics import mask_iou
from warp_deform.tasks.strand_grasp import find_grasp, map_direction, wrap_half_turn


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
            grasp = find_grasp(mask, (row, column))
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
        grasp = find_grasp(mask, (row, column))
        flagged += grasp is not None and grasp.crossing
    assert flagged >= share * 50


def test_a_neighbouring_strand_does_not_turn_the_tangent() -> None:
    t = np.linspace(-60, 60, 200)
    strand = np.stack([80 + 0 * t, 160 + t], axis=1)
    beside = strand + np.array([7.0, 0.0])
    grasp = find_grasp(draw([strand, beside], 3.0), (160, 80))
    assert grasp is not None and not grasp.crossing
    assert abs(abs(grasp.tangent) - np.pi / 2) < 0.01


def test_a_blob_is_a_crossing() -> None:
    mask = np.hypot(*(np.indices((320, 160)) - np.array([160, 80])[:, None, None])) < 8
    grasp = find_grasp(mask, (160, 80))
    assert grasp is not None and grasp.crossing and grasp.spread > 0.5


def test_a_pick_beside_the_cable_moves_to_it_or_finds_nothing() -> None:
    mask = draw([np.array([[20.0, 160.0], [140.0, 160.0]])], 3.0)
    near = find_grasp(mask, (165, 80))
    assert near is not None and near.point[0] == pytest.approx(160.0, abs=0.1)
    assert abs(near.tangent) < 1e-6
    assert find_grasp(mask, (180, 80)) is None
    assert find_grasp(np.zeros((320, 160), bool), (180, 80)) is None


@pytest.mark.parametrize("pick", [(-1, 5), (320, 5), (5, 160), (float("nan"), 5)])
def test_a_pick_outside_of_the_mask(pick: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="outside"):
        find_grasp(np.ones((320, 160), bool), pick)


def test_at_the_rim_of_the_picture() -> None:
    mask = draw([np.array([[-20.0, 100.0], [30.0, 100.0]])], 3.0)
    grasp = find_grasp(mask, (100, 0))
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


# The mask.


def picture(
    rng: np.random.Generator, points: np.ndarray, cable: tuple, foam: tuple, *, width: float = 3.0
) -> tuple[np.ndarray, np.ndarray]:
    """A picture of a cable on foam under uneven light, with noise, and the true mask."""
    share = coverage([points], width, (320, 160))[..., None]
    row, column = np.indices((320, 160))
    light = 0.75 + 0.25 * np.exp(-(((row - 200) / 220) ** 2) - ((column - 40) / 160) ** 2)
    scene = (share * np.array(cable) + (1 - share) * np.array(foam)) * light[..., None]
    noisy = scene + rng.normal(0.0, 4.0, scene.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), share[..., 0] >= 0.5


@pytest.mark.parametrize(
    ("cable", "foam", "polarity"),
    [
        ((225, 225, 230), (50, 52, 55), "brighter"),
        ((30, 30, 30), (190, 190, 185), "darker"),
        ((190, 60, 50), (90, 110, 150), "any"),
        ((200, 180, 60), (70, 70, 75), "any"),
    ],
)
def test_the_mask_of_a_cable(cable: tuple, foam: tuple, polarity: str) -> None:
    rng = np.random.default_rng(2)
    overlaps = []
    for _ in range(6):
        points, _ = curve(rng)
        rgb, true = picture(rng, points, cable, foam)
        mask = segment_cable(rgb, config=SegmentationConfig(polarity=polarity))
        overlaps.append(mask_iou(mask, true))
    assert min(overlaps) > 0.85


def test_an_empty_table_and_specks_give_an_empty_mask() -> None:
    rng = np.random.default_rng(3)
    far = np.array([[-90.0, -90.0], [-80.0, -80.0]])
    rgb, _ = picture(rng, far, (230, 230, 230), (50, 50, 50))
    assert not segment_cable(rgb).any()
    rgb[100:104, 50:54] = 255
    assert not segment_cable(rgb).any()


def test_the_empty_tables_picture_hides_marks_on_the_foam() -> None:
    rng = np.random.default_rng(4)
    points, _ = curve(rng)
    rgb, true = picture(rng, points, (230, 230, 230), (50, 50, 50))
    empty, _ = picture(rng, points + 1000, (230, 230, 230), (50, 50, 50))
    for image in (rgb, empty):
        image[10:16, 10:150] = 120  # a printed line
    assert mask_iou(segment_cable(rgb, empty=empty), true) > 0.85
    assert mask_iou(segment_cable(rgb), true) < 0.85


def test_the_region_keeps_the_table_beside_the_foam_out() -> None:
    rng = np.random.default_rng(5)
    points, _ = curve(rng, length=120)
    rgb, true = picture(rng, points, (230, 230, 230), (50, 50, 50))
    region = np.zeros((320, 160), bool)
    region[20:300, 10:150] = True
    rgb[~region] = (200, 120, 60)
    mask = segment_cable(rgb, region=region)
    assert mask_iou(mask, true & region) > 0.85 and not mask[~region].any()


def test_light_that_splits_the_table_is_refused() -> None:
    rng = np.random.default_rng(6)
    empty = np.full((320, 160, 3), 60, np.uint8)
    rgb = empty.copy()
    rgb[:, :80] = 200
    with pytest.raises(SegmentationError, match=r"50 % of the workspace.*even out the light"):
        segment_cable(rgb, empty=empty)
    with pytest.raises(InputError, match="picture"):
        segment_cable(rgb[..., 0])
    with pytest.raises(InputError, match="size"):
        segment_cable(rgb, region=rng.random((3, 3)) > 0.5)


@pytest.mark.parametrize(
    "change",
    [{"window_px": 40}, {"min_contrast": 0.0}, {"polarity": "blue"}, {"max_share": 0.0}],
)
def test_a_wrong_configuration(change: dict) -> None:
    with pytest.raises(InputError, match="segmentation"):
        SegmentationConfig(**change)
