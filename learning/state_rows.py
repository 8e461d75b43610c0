"""What the rows of a task's ground truth are, three numbers each.

A pose is x, y [m] and -yaw / 15 [rad] of a rigid body or zone, a bead the same of a link of a chain
or of its target, a point x, y, z [m], a displacement x, y [m] and -yaw / 15; what is fixed does not
move with the table, as colours.

Source: Seita et al., ICRA 2021, the baselines' inputs; `warp_deform.tasks` makes them.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

__all__ = ["Row", "state_rows", "yaw_columns"]


class Row(StrEnum):
    """Kinds of rows."""

    POSE = "pose"
    BEAD = "bead"
    POINT = "point"
    DISPLACEMENT = "displacement"
    FIXED = "fixed"


_BAG = ((Row.BEAD, 32), (Row.DISPLACEMENT, 1))
_BAGS_AND_BLOCK = (*_BAG, *_BAG, (Row.POSE, 1), (Row.FIXED, 2))
_ROWS: dict[str, tuple[tuple[Row, int], ...]] = {
    "cable-ring": ((Row.BEAD, 64),),
    "cable-ring-notarget": ((Row.BEAD, 32),),
    "cable-shape": ((Row.POSE, 1), (Row.BEAD, 48)),
    "cable-shape-notarget": ((Row.BEAD, 48),),
    "cable-line-notarget": ((Row.BEAD, 48),),
    "fabric-cover": ((Row.POSE, 1), (Row.POINT, 100)),
    "fabric-flat": ((Row.POSE, 1), (Row.POINT, 100)),
    "fabric-flat-notarget": ((Row.POINT, 200),),
    "bag-alone-open": _BAG,
    "bag-items-1": ((Row.POSE, 1), *_BAG, (Row.POSE, 1)),
    "bag-items-2": ((Row.POSE, 1), *_BAG, (Row.POSE, 2)),
    "bag-color-goal": (*_BAGS_AND_BLOCK, *_BAGS_AND_BLOCK),
    "block-notarget": ((Row.POSE, 2),),
    "cable-mask-goal": ((Row.BEAD, 180),),
}


def state_rows(task: str) -> np.ndarray:
    """Kinds of a task's rows (n,), `Row` as str; none where the task is not the benchmark's."""
    kinds = _ROWS.get(task, ())
    return np.repeat([kind.value for kind, _ in kinds], [count for _, count in kinds])


def yaw_columns(task: str) -> tuple[int, ...]:
    """Where in a task's ground truth -yaw / 15 of rigid bodies and zones stand."""
    return tuple(int(3 * row + 2) for row in np.flatnonzero(state_rows(task) == Row.POSE))
