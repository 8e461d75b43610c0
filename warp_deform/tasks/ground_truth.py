"""State vectors of the paper's ground-truth baselines, and what their numbers are.

Source: Seita et al., ICRA 2021, section on baselines: a rigid body is (x, y, -yaw / 15), because
the policies count rotations in steps of 15 degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from ..errors import InputError

__all__ = [
    "YAW_SCALE",
    "Row",
    "Rows",
    "pose_rows",
    "row_count",
    "row_kinds",
    "rows_of",
    "yaw_columns",
]

YAW_SCALE = 15.0


class Row(Enum):
    """What three numbers of a ground truth are: how they change when the table is turned."""

    POSE = "pose"
    """x, y [m] and -yaw / 15 [rad] of a rigid body or zone."""
    BEAD = "bead"
    """The same of a link of a chain, or of its target."""
    POINT = "point"
    """x, y, z [m]."""
    DISPLACEMENT = "displacement"
    """x, y [m] and -yaw / 15 [rad] of a pose relative to another one."""
    FIXED = "fixed"
    """What does not move with the table, as colours."""


Rows = tuple[tuple[Row, int], ...]
"""A ground truth as runs of rows: kind and number, three numbers each row."""


def row_count(rows: Rows) -> int:
    """Number of rows.

    Raises:
        InputError: these are no runs of rows.
    """
    if not (isinstance(rows, tuple) and all(map(_is_run, rows))):
        raise InputError(
            f"ground_truth_rows is {repr(rows)[:60]}; it must be a tuple of pairs (Row, number of "
            "rows)"
        )
    return sum(count for _, count in rows)


def _is_run(run: object) -> bool:
    return (
        isinstance(run, tuple)
        and len(run) == 2
        and isinstance(run[0], Row)
        and type(run[1]) is int
        and run[1] >= 1
    )


def row_kinds(rows: Rows) -> np.ndarray:
    """Kind of every row (n,), as objects.

    Examples:
        >>> row_kinds(((Row.POSE, 1), (Row.POINT, 2))).tolist()
        [<Row.POSE: 'pose'>, <Row.POINT: 'point'>, <Row.POINT: 'point'>]
    """
    kinds = np.empty(row_count(rows), dtype=object)
    kinds[:] = [kind for kind, count in rows for _ in range(count)]
    return kinds


def rows_of(kinds: np.ndarray, wanted: Sequence[Row]) -> np.ndarray:
    """Which of the rows `kinds` (n,) are of one of the wanted kinds (n,) bool."""
    return np.array([kind in wanted for kind in kinds], dtype=bool)


def yaw_columns(rows: Rows) -> tuple[int, ...]:
    """Where in a ground truth -yaw / 15 of rigid bodies and zones stand.

    Examples:
        >>> yaw_columns(((Row.POINT, 1), (Row.POSE, 2)))
        (5, 8)
    """
    return tuple(int(3 * row + 2) for row in np.flatnonzero(rows_of(row_kinds(rows), [Row.POSE])))


def pose_rows(xy: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
    """Rows (n, 3) float32 of x, y [m] and -yaw / 15 [rad] from `xy` (n, 2 or 3) and `yaw` (n,)."""
    xy = np.atleast_2d(np.asarray(xy, dtype=float))[:, :2]
    return np.column_stack([xy, np.broadcast_to(-np.asarray(yaw) / YAW_SCALE, len(xy))]).astype(
        np.float32
    )
