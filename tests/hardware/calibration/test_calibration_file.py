"""The touched table, the calibration file, and the view from above that it gives."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixtures.board_photographs import INTRINSICS, SIZE, TABLE, camera_above
from fixtures.safety_spy import ARM, solved_line
from fixtures.touched_table import TouchedTable

from hardware import GraspError, MotionError, SafetyViolation
from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane, fit_table_plane
from hardware.calibration.calibration import Calibration
from hardware.calibration.homography import plane_homography
from hardware.measuring.touch_off import touch_off
from hardware.vision.top_down_view import TopDownView
from warp_deform.errors import InputError

# The table.


def held(spy: TouchedTable, limits: SafetyLimits) -> SafeRobot:
    return SafeRobot(spy, limits, line_solver=solved_line)


CORNERS = [(0.38, -0.27), (0.38, 0.27), (0.62, 0.27), (0.62, -0.27), (0.5, 0.0)]


def test_touch_off_finds_the_table() -> None:
    provisional = SafetyLimits(table=TablePlane(-0.015))
    spy = TouchedTable(object_width=0.0)
    points = touch_off(held(spy, provisional), CORNERS)
    plane, residuals = fit_table_plane(points)
    assert np.abs(plane.z(np.array(CORNERS)) - spy.true.z(np.array(CORNERS))).max() < 1e-4
    assert np.abs(residuals).max() < 1e-4


def test_touch_off_that_touches_nothing_or_holds_something() -> None:
    limits = SafetyLimits(table=TablePlane(0.03))  # guessed too high
    with pytest.raises(InputError, match=r"point 1: nothing met down to 0.040 m; lower"):
        touch_off(held(TouchedTable(object_width=0.0), limits), CORNERS)
    limits = SafetyLimits(table=TablePlane(-0.015))
    with pytest.raises(GraspError, match="not closed"):
        touch_off(held(TouchedTable(object_width=0.01), limits), CORNERS)
    spy = TouchedTable()
    with pytest.raises(SafetyViolation, match="workspace x"):
        touch_off(held(spy, limits), [*CORNERS, (0.9, 0.0)])
    assert not spy.lines


def test_a_touch_in_mid_air_is_no_table() -> None:
    limits = SafetyLimits(table=TablePlane(-0.015))

    class Jerky(TouchedTable):
        true = TablePlane(-0.015 + 0.06 - 0.004 - 0.009)

    spy = Jerky(object_width=0.0)
    with pytest.raises(MotionError, match=r"4\.0 mm below where its descent to point 1 began"):
        touch_off(held(spy, limits), CORNERS)
    assert ARM.pose(spy.q)[2, 3] == pytest.approx(0.045, abs=1e-4)  # up again


@pytest.mark.parametrize(("felt", "refused"), [(1.4, False), (1.6, True)])
def test_a_hand_that_feels_something_in_the_air_does_not_go_down(
    felt: float, refused: bool
) -> None:
    """The threshold is one of forces, not of changes: what is felt already is missing from it."""
    spy = TouchedTable(object_width=0.0, force=np.array([0.0, felt, 0.0, 0.0, 0.0, 0.0]))
    robot = held(spy, SafetyLimits(table=TablePlane(-0.015)))
    if refused:
        with pytest.raises(MotionError, match=r"feels 1\.6 N in the air, 1\.5 N are allowed; set"):
            touch_off(robot, CORNERS)
        assert len(spy.lines) == 1
    else:
        assert len(touch_off(robot, CORNERS)) == len(CORNERS)


@pytest.mark.parametrize("noise", [0.0, 0.3e-3])
def test_table_plane(noise: float) -> None:
    rng = np.random.default_rng(3)
    xy = np.array([[0.31, -0.3], [0.31, 0.3], [0.61, -0.3], [0.61, 0.3], [0.45, 0.0]])
    true = TablePlane(0.012, slope_x=-0.01, slope_y=0.004)
    z = true.z(xy) + rng.normal(0.0, noise, 5)
    plane, residuals = fit_table_plane(np.column_stack([xy, z]))
    assert np.abs(plane.z(xy) - true.z(xy)).max() <= 3.0 * noise + 1e-12
    np.testing.assert_allclose(z - plane.z(xy), residuals, atol=1e-12)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0.3, 0.0, 0.0], [0.4, 0.1, 0.0], [0.5, -0.1, 0.0]], "4 or more"),
        ([[0.3 + 0.1 * i, 0.2 * i, 0.0] for i in range(4)], "of a line"),
        ([[0.3, -0.3, 0], [0.3, 0.3, 0], [0.6, 0.3, 0], [0.6, -0.3, 0.02]], "mm off the plane"),
        ([[0.3, -0.3, 0], [0.3, 0.3, 0.06], [0.6, 0.3, 0.06], [0.6, -0.3, 0]], "slopes"),
        ([[0.3, -0.3, 0], [0.3, 0.3, np.nan], [0.6, 0.3, 0], [0.6, -0.3, 0]], "not finite"),
    ],
)
def test_bad_touches_are_refused(points: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        fit_table_plane(np.array(points))


# The file.


def calibration(**changes: object) -> Calibration:
    values = {
        "robot_id": "panda-1",
        "camera_id": "wrist",
        "home_q": np.array(HOME_Q),
        "intrinsics": INTRINSICS,
        "base_H_pixel": plane_homography(INTRINSICS, camera_above(), TABLE),
        "table": TABLE,
        "method": "charuco",
        "error_m": 0.4e-3,
        "details": {"points": 24},
    }
    return Calibration(**{**values, **changes})


def test_a_calibration_is_read_as_it_was_written(tmp_path: Path) -> None:
    made, path = calibration(), tmp_path / "sub" / "setup.json"
    made.save(path)
    read = Calibration.load(path)
    assert read.to_record() == made.to_record() and read.digest() == made.digest()
    assert [p.name for p in path.parent.iterdir()] == ["setup.json"]
    xy = np.array([[0.4, -0.1], [0.55, 0.2]])
    np.testing.assert_allclose(read.pixel_to_base(read.base_to_pixel(xy))[:, :2], xy, atol=1e-8)
    np.testing.assert_allclose(read.pixel_to_base(read.base_to_pixel(xy))[:, 2], TABLE.z(xy))
    assert calibration(error_m=0.5e-3).digest() != made.digest()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("schema", 2),
        ("schema", True),
        ("schema", None),
        ("robot_id", 7),
        ("home_q", [0.0] * 6),
        ("home_q", ["a"] * 7),
        ("home_q", [[0.0], [0.0, 1.0]]),
        ("intrinsics", None),
        ("intrinsics", {"size": [1280, 720], "matrix": [[1]], "distortion": []}),
        ("intrinsics", {"size": [1280.5, 720], "matrix": [[1]], "distortion": []}),
        ("base_H_pixel", [[0.0] * 3] * 3),
        ("base_H_pixel", [[1, 0, 0], [0, 1, 0], [0.002, 0, -1]]),
        ("table", {"height_m": "high", "slope_x": 0, "slope_y": 0}),
        ("table", {"height_m": 0.0, "slope_x": 0.2, "slope_y": 0}),
        ("method", "guess"),
        ("error_m", 0.004),
        ("error_m", True),
        ("details", []),
    ],
)
def test_a_bad_calibration_file_is_one_line(tmp_path: Path, key: str, value: object) -> None:
    path = tmp_path / "setup.json"
    path.write_text(json.dumps({**calibration().to_record(), key: value}))
    with pytest.raises(InputError, match=r"setup\.json") as caught:
        Calibration.load(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"\xff\xfe", b'{"schema": NaN}', b"[" * 10**5])
def test_a_file_that_is_no_calibration(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "setup.json"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"calibration .*setup\.json"):
        Calibration.load(path)
    with pytest.raises(InputError, match="is missing: make it with `franka calibrate`"):
        Calibration.load(tmp_path / "none.json")


# The view from above.


def test_a_rectified_picture_shows_things_where_they_are() -> None:
    made = calibration(base_H_pixel=plane_homography(INTRINSICS, camera_above(height=0.95), TABLE))
    view = TopDownView()
    xy = np.array([[0.40, -0.22], [0.62, 0.25], [0.51, 0.02]])
    image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    for column, row in made.base_to_pixel(xy):
        cv2.circle(image, (round(column), round(row)), 4, 255, -1)
    seen = view.rectify(image, made)
    assert seen.shape == (320, 160)
    _, labels, _, centres = cv2.connectedComponentsWithStats((seen > 127).astype(np.uint8))
    assert labels.max() == 3
    found = view.pixel_to_base(centres[1:, ::-1])
    for point in xy:
        assert np.linalg.norm(found - point, axis=1).min() < 1e-3


def test_a_view_that_does_not_fit_is_refused() -> None:
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    low = calibration(base_H_pixel=plane_homography(INTRINSICS, camera_above(height=0.3), TABLE))
    with pytest.raises(InputError, match="% of the workspace is outside"):
        TopDownView().rectify(image, low)
    with pytest.raises(InputError, match="the calibration is for 1280 x 720"):
        TopDownView().rectify(image[::2, ::2], low)
    with pytest.raises(InputError, match="square pixels"):
        TopDownView(shape=(100, 100))


def test_pixels_of_the_view_and_back() -> None:
    view = TopDownView()
    corner = view.pixel_to_base(np.array([-0.5, -0.5]))
    np.testing.assert_allclose(corner, [0.335, -0.30])
    pixels = np.random.default_rng(0).uniform(0, 160, (20, 2))
    np.testing.assert_allclose(view.base_to_pixel(view.pixel_to_base(pixels)), pixels, atol=1e-9)
