"""Where a camera on the hand is: AX = XB from pictures of a board that stands still.

OpenCV's closed form is the start; least squares then makes the board stand as still as the
measurements allow, each error in units of its noise. The closed form weighs turns and translations
as its algebra has them, the measurements do not.

Source: Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", 1994;
Tabb and Ahmad Yousef, "Solving the robot-world hand-eye(s) calibration problem with iterative
methods", 2017.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from warp_deform.errors import InputError

from .homography import MAX_ERROR
from .poor_fit import PoorFit

__all__ = ["MIN_POSES", "HandEye", "calibrate_hand_eye"]

MIN_POSES = 8
"""Fewest poses that give a result."""
# Turns between poses that tell a camera's place: along two axes, by this much [rad], 11 degrees.
_MIN_TURN = 0.2
# Noise of a board's pose relative to its place: 2 mrad go with 0.7 mm [m/rad].
_LEVER = 0.35


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera's pose on the hand.

    Attributes:
        tcp_T_camera: shape (4, 4) [m]
        base_T_board: where the board stood, shape (4, 4) [m]
        residuals_m: how far each picture puts the board from there, shape (n,)
        turns_rad: how far each picture turns it from there, shape (n,)
    """

    tcp_T_camera: np.ndarray
    base_T_board: np.ndarray
    residuals_m: np.ndarray
    turns_rad: np.ndarray

    @property
    def error_m(self) -> float:
        """Root mean square of `residuals_m` [m]."""
        return math.sqrt(float((self.residuals_m**2).mean()))

    def report(self) -> str:
        """Return the figures as a line for people."""
        return (
            f"hand-eye of {len(self.residuals_m)} poses: the board stands still to "
            f"{1e3 * self.error_m:.2f} mm rms, {1e3 * self.residuals_m.max():.2f} mm at most, and "
            f"{1e3 * float(np.sqrt((self.turns_rad**2).mean())):.1f} mrad"
        )


def calibrate_hand_eye(base_T_tcp: np.ndarray, camera_T_board: np.ndarray) -> HandEye:
    """Return the camera's pose on the hand.

    Args:
        base_T_tcp: poses of the hand [m], (n, 4, 4); tilt it by some 25 degrees about two axes
        camera_T_board: poses of the board in the pictures taken there [m], (n, 4, 4)

    Raises:
        InputError: too few poses, or too much alike
        PoorFit: the board does not stand still to 3 mm rms
    """
    hand, seen = np.asarray(base_T_tcp, dtype=float), np.asarray(camera_T_board, dtype=float)
    if hand.shape != seen.shape or hand.ndim != 3 or hand.shape[1:] != (4, 4):
        raise InputError(f"poses need shape (n, 4, 4) both, not {hand.shape} and {seen.shape}")
    if len(hand) < MIN_POSES:
        raise InputError(f"hand-eye needs {MIN_POSES} poses, better 15; {len(hand)} were given")
    if not (np.isfinite(hand).all() and np.isfinite(seen).all()):
        raise InputError("a pose is not finite; take that picture again")
    _check_turns(hand)
    rotation, translation = cv2.calibrateHandEye(
        hand[:, :3, :3],
        hand[:, :3, 3],
        seen[:, :3, :3],
        seen[:, :3, 3],
        # By keyword: a fifth positional argument is an output array, silently.
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = rotation, translation.ravel()
    if not np.isfinite(start).all():
        raise InputError("the poses do not tell where the camera is; tilt the hand about two axes")
    tcp_T_camera, base_T_board = _refine(hand, seen, start)
    errors = _errors(hand, seen, tcp_T_camera, base_T_board)
    hand_eye = HandEye(
        tcp_T_camera,
        base_T_board,
        np.linalg.norm(errors[:, :3], axis=1),
        np.linalg.norm(errors[:, 3:], axis=1),
    )
    if not hand_eye.error_m <= MAX_ERROR:
        worst = int(np.argmax(hand_eye.residuals_m))
        raise PoorFit(
            f"{hand_eye.report()}; allowed: {1e3 * MAX_ERROR:g} mm rms, so it is refused; take "
            f"picture {worst + 1} again first, and fix board and camera",
            worst=worst,
        )
    return hand_eye


def _check_turns(hand: np.ndarray) -> None:
    """Refuse poses that turn about fewer than two axes."""
    turns = [cv2.Rodrigues(T[:3, :3] @ hand[0, :3, :3].T)[0].ravel() for T in hand[1:]]
    spread = np.linalg.svd(np.array(turns), compute_uv=False) / math.sqrt(len(turns))
    if spread[1] < _MIN_TURN / 2:
        raise InputError(
            "the hand's poses turn about one axis only; tilt it by some 25 degrees about two"
        )


def _refine(hand: np.ndarray, seen: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tcp_T_camera and base_T_board with the least errors, each in units of its noise."""
    from scipy.optimize import least_squares  # slow to import

    boards = hand @ start @ seen
    board = np.eye(4)
    u, _, v = np.linalg.svd(boards[:, :3, :3].mean(axis=0))
    board[:3, :3], board[:3, 3] = u @ v, boards[:, :3, 3].mean(axis=0)

    def moved(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return start @ _pose(change[:6]), board @ _pose(change[6:])

    def residual(change: np.ndarray) -> np.ndarray:
        return (_errors(hand, seen, *moved(change)) / [1, 1, 1, *[1 / _LEVER] * 3]).ravel()

    solution = least_squares(residual, np.zeros(12), x_scale=[1e-2] * 12, method="lm")
    return moved(solution.x)


def _errors(
    hand: np.ndarray, seen: np.ndarray, tcp_T_camera: np.ndarray, base_T_board: np.ndarray
) -> np.ndarray:
    """Return how far the seen board is from where it should be seen, (n, 6) [m] and [rad]."""
    expected = np.linalg.inv(hand @ tcp_T_camera) @ base_T_board
    shifts = seen[:, :3, 3] - expected[:, :3, 3]
    turns = [
        cv2.Rodrigues(S[:3, :3] @ E[:3, :3].T)[0].ravel()
        for S, E in zip(seen, expected, strict=True)
    ]
    return np.hstack([shifts, turns])


def _pose(change: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a translation [m] and a rotation vector [rad], six numbers."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.asarray(change[3:]))[0], change[:3]
    return T
