"""What is handed to a robot: numbers, joints and poses, refused where they cannot be meant."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence

import numpy as np

from warp_deform.errors import InputError

from .panda import Q_MAX, Q_MIN

__all__ = ["check_joints", "check_line", "check_pose", "check_range", "real_number", "shown"]


def real_number(name: str, value: object) -> float:
    """Return a real number, which may be infinite or not a number at all: ranges refuse those.

    Raises:
        InputError: it is a bool, text, None, complex, an array or anything else
    """
    real = isinstance(value, (int, float, np.integer, np.floating))
    if not real or isinstance(value, bool):
        raise InputError(f"{name}: a number is needed, not {shown(value)}")
    try:
        return float(value)  # type: ignore[arg-type]
    except OverflowError as error:
        raise InputError(f"{name}: {shown(value)} is beyond any number that is meant") from error


def shown(value: object) -> str:
    """Return a value in a few words on one line, for a message."""
    return f"{type(value).__name__} {' '.join(reprlib.repr(value).split())}"


def _numbers(name: str, value: object) -> np.ndarray:
    """Return a float64 copy of real numbers: whoever holds `value` may write into it meanwhile."""
    try:
        array = np.array(value)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}: an array of numbers is needed, not {shown(value)}; its rows must be as long "
            "as each other"
        ) from error
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name}: an array of real numbers is needed, not {shown(value)}")
    return array.astype(np.float64)


def check_joints(q: np.ndarray | Sequence[float]) -> np.ndarray:
    """Return joint waypoints [rad] as a copy (N, 7), float64.

    Raises:
        InputError: no real numbers, wrong shape, not finite, or beyond the joint limits
    """
    points = np.atleast_2d(_numbers("q", q))
    if points.ndim != 2 or points.shape[1] != 7 or not len(points):
        raise InputError(f"q: shape (7,) or (N, 7), not {np.shape(q)}")
    if not np.isfinite(points).all():
        raise InputError("q: joint positions must be finite [rad]")
    beyond = (points < Q_MIN) | (points > Q_MAX)
    if beyond.any():
        row, joint = map(int, np.argwhere(beyond)[0])
        raise InputError(
            f"q: joint {joint + 1} at {points[row, joint]:.4f} rad is beyond its limits "
            f"{Q_MIN[joint]} to {Q_MAX[joint]}; choose another waypoint"
        )
    return points


def check_pose(base_T_tcp: np.ndarray) -> np.ndarray:
    """Return a pose as a copy (4, 4), float64.

    Raises:
        InputError: no real numbers, or no rigid transform
    """
    T = _numbers("base_T_tcp", base_T_tcp)
    if T.shape != (4, 4):
        raise InputError(f"base_T_tcp: shape (4, 4), not {T.shape}")
    if not np.isfinite(T).all():
        raise InputError("base_T_tcp: its numbers must be finite")
    R = T[:3, :3]
    # An entry of a rotation is at most 1; the product of huge ones would overflow.
    rigid = np.abs(R).max() < 2.0 and np.allclose(R.T @ R, np.eye(3), atol=1e-6)
    if not (rigid and np.linalg.det(R) > 0.0 and np.array_equal(T[3], [0, 0, 0, 1])):
        raise InputError("base_T_tcp: not a rigid transform; its rotation must be orthonormal")
    return T


def check_line(
    base_T_tcp: np.ndarray,
    *,
    speed: float,
    stop_force_N: float | None = None,
    most_force_N: float = np.inf,
) -> np.ndarray:
    """Return the target of a straight line as `check_pose` does; InputError, too, of the others."""
    target = check_pose(base_T_tcp)
    check_range("speed", speed, low=0.0, high=1.7, unit="m/s")
    if stop_force_N is not None:
        check_range("stop_force_N", stop_force_N, low=0.0, high=most_force_N, unit="N")
    return target


def check_range(name: str, value: float, *, low: float, high: float, unit: str) -> float:
    """Return `value`.

    Raises:
        InputError: it is no number, or not above `low` and at most `high`
    """
    number = real_number(name, value)
    if not low < number <= high:
        raise InputError(f"{name}: above {low} and at most {high} {unit}, not {value}")
    return number
