"""The mask of a cable: under uneven light, on marked foam, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.cable_drawings import coverage, curve

from hardware.vision.segmentation import SegmentationConfig, SegmentationError, segment_cable
from warp_deform.errors import InputError
from warp_deform.tasks.metrics import mask_iou


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
