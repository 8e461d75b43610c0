"""Calibration: homographies from rendered boards, and the camera on the hand."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from fixtures.board_photographs import (
    BOARD,
    INTRINSICS,
    SIZE,
    TABLE,
    camera_above,
    photograph,
    projected,
    rotation,
    transform,
)

from hardware.arm.table_plane import TablePlane
from hardware.calibration.charuco import Corners, board_pose, calibrate_intrinsics, find_corners
from hardware.calibration.hand_eye import calibrate_hand_eye
from hardware.calibration.homography import (
    apply_homography,
    board_on_table,
    fit_homography,
    plane_homography,
    solve_homography,
)
from hardware.calibration.poor_fit import PoorFit
from warp_deform.errors import InputError

# The homography.


@pytest.fixture(scope="module")
def boards() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Photographs of a board on the table: pictures, base_T_camera and base_T_board of each."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(4):
        base_T_camera = camera_above(tuple(rng.uniform(-0.15, 0.15, 2)), yaw=rng.uniform(-0.5, 0.5))
        R = rotation(0, 0, rng.uniform(-0.4, 0.4)) @ np.diag([1.0, -1.0, -1.0])
        base_T_board = transform(R, [0.41, 0.10 + rng.uniform(-0.02, 0.02), 0.0])
        rgb = photograph(rng, np.linalg.inv(base_T_camera) @ base_T_board)
        made.append((rgb, base_T_camera, base_T_board))
    return made


def test_homography_of_rendered_boards(
    boards: list, record_property: Callable[[str, object], None]
) -> None:
    errors = []
    for rgb, base_T_camera, base_T_board in boards:
        corners = find_corners(rgb, BOARD)
        assert len(corners.ids) >= 20
        placed = (base_T_board[:3, :3] @ BOARD.corners_m.T).T + base_T_board[:3, 3]
        touched = np.array([0, 5, 18, 23])
        rng = np.random.default_rng(len(errors))
        xy = placed[touched, :2] + rng.normal(0.0, 0.2e-3, (4, 2))
        base_xy = board_on_table(corners, BOARD, touched, xy)
        fit = fit_homography(corners.pixels, base_xy, INTRINSICS)
        assert "points: left out" in fit.report()
        true = plane_homography(INTRINSICS, base_T_camera, TablePlane(0.0))
        probe = INTRINSICS.undistort(corners.pixels)
        truth = np.linalg.norm(
            apply_homography(fit.base_H_pixel, probe) - apply_homography(true, probe), axis=1
        )
        errors.append((fit.error_m, truth.max()))
    left_out, true_error = np.max(errors, axis=0)
    record_property("worst error of a point left out [mm]", round(1e3 * float(left_out), 3))
    assert left_out < 1e-3
    assert true_error < 1e-3


def test_homography_of_touched_points() -> None:
    true = plane_homography(INTRINSICS, camera_above(), TablePlane(0.0))
    xy = np.array([[0.33, -0.2], [0.33, 0.2], [0.6, -0.2], [0.6, 0.2], [0.46, 0.0], [0.4, 0.1]])
    pixels = INTRINSICS.distort(apply_homography(np.linalg.inv(true), xy))
    fit = fit_homography(pixels, xy, INTRINSICS)
    assert fit.error_m < 1e-6 and fit.residuals_m.max() < 1e-6
    for spoilt, message in (
        (xy + np.eye(6)[:, :1] * [0.03, 0.0], r"allowed: 3 mm rms.*no one point"),
        (xy[:, ::-1], "wrong way round"),
        (xy * [1.0, 0.0] + [0.0, 0.01], "near a line"),
        (np.where(np.eye(6)[:, :2] > 0, np.nan, xy), "not finite"),
    ):
        with pytest.raises(InputError, match=message):
            fit_homography(pixels, spoilt, INTRINSICS)
    with pytest.raises(InputError, match="four fit any homography"):
        fit_homography(pixels[:4], xy[:4], INTRINSICS)


def test_the_wrong_one_of_touched_points_is_named() -> None:
    """The point that the others predict worst is a right one in a fifth of these cases."""
    true = plane_homography(INTRINSICS, camera_above(), TablePlane(0.0))
    grid = np.stack(np.meshgrid([0.36, 0.485, 0.61], [-0.25, 0.0, 0.25]), axis=-1).reshape(-1, 2)
    named = predicted_worst = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        xy = grid + rng.normal(0.0, 0.01, (9, 2))
        pixels = INTRINSICS.distort(apply_homography(np.linalg.inv(true), xy))
        pixels += rng.normal(0.0, 0.7, (9, 2))
        touched = xy + rng.normal(0.0, 0.4e-3, (9, 2))
        assert fit_homography(pixels, touched, INTRINSICS).error_m < 2.5e-3
        wrong, turn = seed % 9, rng.uniform(0.0, 2 * np.pi)
        touched[wrong] += 0.012 * np.array([np.cos(turn), np.sin(turn)])
        with pytest.raises(PoorFit, match=r"measure point \d again") as caught:
            fit_homography(pixels, touched, INTRINSICS)
        fit = solve_homography(pixels, touched, INTRINSICS)
        named += caught.value.worst == wrong
        predicted_worst += int(np.argmax(fit.left_out_m)) == wrong
    assert named == 60 and predicted_worst < 54
    few = [0, 2, 6, 8, wrong, 4]  # some five of them always fit
    assert len(set(few)) == 6
    with pytest.raises(PoorFit, match="no one point is to blame: measure more") as caught:
        fit_homography(pixels[few], touched[few], INTRINSICS)
    assert caught.value.worst is None


def test_a_board_touched_wrongly_is_refused() -> None:
    corners = Corners(np.arange(24), np.zeros((24, 2)))
    ids = np.array([0, 5, 18])
    xy = BOARD.corners_m[ids, :2]
    for ids_given, xy_given, message in (
        (ids, xy * 1.05, "mm from where the others put it"),
        (ids[:2], xy[:2], "three or more"),
        (np.array([0, 1, 2]), BOARD.corners_m[:3, :2], "near a line"),
        (np.array([0, 5, 24]), xy, "numbers 0 to 23"),
    ):
        with pytest.raises(InputError, match=message):
            board_on_table(corners, BOARD, ids_given, xy_given)


def test_a_picture_without_a_board() -> None:
    with pytest.raises(InputError, match=r"0 of the board's 24 corners"):
        find_corners(np.full((720, 1280, 3), 128, np.uint8), BOARD)


def test_the_pose_of_a_board(boards: list) -> None:
    for rgb, base_T_camera, base_T_board in boards:
        corners = find_corners(rgb, BOARD)
        found = board_pose(corners, BOARD, INTRINSICS)
        wanted = np.linalg.inv(base_T_camera) @ base_T_board
        assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 2e-3
        assert np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ wanted[:3, :3].T)[0]) < 0.01
    wrong = Corners(corners.ids, corners.pixels[::-1] * [1.0, 1.3])
    with pytest.raises(InputError, match="fit no pose"):
        board_pose(wrong, BOARD, INTRINSICS)


def test_intrinsics_from_views() -> None:
    rng = np.random.default_rng(2)
    views = []
    for _ in range(14):
        R = rotation(*rng.uniform(-0.5, 0.5, 3))
        middle = BOARD.corners_m.mean(axis=0)
        T = transform(R, [*rng.uniform([-0.12, -0.06], [0.12, 0.06]), rng.uniform(0.35, 0.6)])
        T[:3, 3] -= R @ middle
        pixels = projected(BOARD.corners_m, T)
        views.append(Corners(np.arange(24), pixels + rng.normal(0, 0.1, (24, 2))))
    found, rms = calibrate_intrinsics(views, BOARD, SIZE)
    assert rms < 0.2
    np.testing.assert_allclose(found.matrix, INTRINSICS.matrix, atol=8.0)
    with pytest.raises(InputError, match="8 views"):
        calibrate_intrinsics(views[:5], BOARD, SIZE)
    views[0] = Corners(views[0].ids, views[0].pixels + rng.normal(0, 20.0, (24, 2)))
    with pytest.raises(PoorFit, match=r"px only.*take view 1 again") as caught:
        calibrate_intrinsics(views, BOARD, SIZE)
    assert caught.value.worst == 0


# Hand-eye.


def hand_eye_poses(
    seed: int, count: int = 15, *, place: float = 0.7e-3, turn: float = 2e-3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of the hand, of the board as seen with noise [m], [rad], and the true tcp_T_camera."""
    rng = np.random.default_rng(seed)
    camera = transform(rotation(*rng.normal(0.0, 0.05, 3)), [0.05, 0.03, -0.06])
    board = transform(rotation(np.pi, 0, 0), [0.45, 0.0, 0.0])
    hands, seen = [], []
    for _ in range(count):
        R = rotation(*rng.uniform(-0.436, 0.436, 2), rng.uniform(-0.5, 0.5))
        position = rng.uniform([0.35, -0.15, 0.35], [0.55, 0.15, 0.5])
        hand = transform(R @ np.diag([1.0, -1.0, -1.0]), position)
        view = np.linalg.inv(hand @ camera) @ board
        view[:3, 3] += rng.normal(0.0, place, 3)
        view[:3, :3] = rotation(*rng.normal(0.0, turn, 3)) @ view[:3, :3]
        hands.append(hand)
        seen.append(view)
    return np.array(hands), np.array(seen), camera


def test_hand_eye_at_15_poses(record_property: Callable[[str, object], None]) -> None:
    errors = []
    for seed in range(40):
        hands, seen, camera = hand_eye_poses(seed)
        found = calibrate_hand_eye(hands, seen)
        errors.append(np.linalg.norm(found.tcp_T_camera[:3, 3] - camera[:3, 3]))
        assert found.error_m < 2.5e-3 and "15 poses" in found.report()
    record_property("median error of the camera [mm]", round(1e3 * float(np.median(errors)), 3))
    assert np.median(errors) < 1.2e-3
    assert np.max(errors) < 3e-3


def test_hand_eye_without_noise_is_exact() -> None:
    hands, seen, camera = hand_eye_poses(0, place=0.0, turn=0.0)
    found = calibrate_hand_eye(hands, seen)
    np.testing.assert_allclose(found.tcp_T_camera, camera, atol=1e-9)


def test_bad_hand_eye_poses_are_refused() -> None:
    hands, seen, _ = hand_eye_poses(0)
    with pytest.raises(InputError, match="needs 8 poses"):
        calibrate_hand_eye(hands[:7], seen[:7])
    moved = seen.copy()
    moved[3, :3, 3] += [0.03, 0.0, 0.0]
    with pytest.raises(PoorFit, match="take picture 4 again") as caught:
        calibrate_hand_eye(hands, moved)
    assert caught.value.worst == 3
    # More than the calibration file takes is refused here, where it says which picture was worst.
    shaky, seen_shaky, _ = hand_eye_poses(0, place=2.2e-3)
    with pytest.raises(InputError, match=r"stands still to 3\.\d+ mm rms.* allowed: 3 mm rms"):
        calibrate_hand_eye(shaky, seen_shaky)
    turned = np.array([transform(rotation(0, 0, 0.05 * i), hands[i, :3, 3]) for i in range(15)])
    with pytest.raises(InputError, match="one axis only"):
        calibrate_hand_eye(turned, seen)
    with pytest.raises(InputError, match="shape"):
        calibrate_hand_eye(hands, seen[1:])


def test_hand_eye_gives_the_same_homography_as_touching() -> None:
    base_T_camera = camera_above()
    H = plane_homography(INTRINSICS, base_T_camera, TABLE)
    xy = np.random.default_rng(0).uniform([0.33, -0.2], [0.6, 0.2], (8, 2))
    points = np.column_stack([xy, TABLE.z(xy)])
    camera_T_base = np.linalg.inv(base_T_camera)
    found = apply_homography(H, INTRINSICS.undistort(projected(points, camera_T_base)))
    np.testing.assert_allclose(found, xy, atol=1e-7)
    upwards = base_T_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="does not look down"):
        plane_homography(INTRINSICS, upwards, TABLE)
