"""`Workplace`: the home pose for pictures and the part of the table that is worked on, per setup.

The home pose and the workspace are given as flags when a setup is calibrated, and stored with it;
whatever runs afterwards has them from there. Safety limits, views and simulated twins are made from
this, so that all of them mean the same table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError

from ..arm.limits import SafetyLimits
from ..arm.panda import HOME_Q, Q_MAX, Q_MIN
from ..arm.table_plane import TablePlane
from ..support.json_file import read_json, read_numbers, write_json
from ..vision.top_down_view import TopDownView

__all__ = ["Workplace"]

_SQUARE = 1e-3  # share by which the sides may miss two to one
# [m] along x, and rounding: a chain of 45 cm has room within, and the arm reaches it.
_WIDTH, _ROUNDING = (0.2, 0.5), 1e-9
_SAME_Q, _SAME_M = 1e-3, 1e-4  # [rad], [m]: numbers typed with so many digits are the same
_REACH = 0.855  # [m] from the base's axis, the vendor's figure
_FILE = "workplace.json"


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """The home pose and the workspace.

    The default home pose is the vendor's and the paper's: `HOME_JOINTS` of frankapy, the hand
    straight down at (0.307, 0, 0.487) m. The default workspace is the paper's foam where the hand
    reaches all of it; the paper's own limits, x 0.31 to 0.63 and y -0.31 to 0.33 m, are allowed.

    Raises:
        InputError: the arm cannot stand like that, or the workspace cannot be seen or reached
    """

    home_q: tuple[float, ...] = HOME_Q
    """Joint positions at which pictures are taken [rad]."""
    x: tuple[float, float] = (0.335, 0.635)
    """Workspace along x in the base frame [m]."""
    y: tuple[float, float] = (-0.30, 0.30)
    """Workspace along y [m], twice as long: pictures have 320 x 160 square pixels."""

    def __post_init__(self) -> None:
        q = np.array(self.home_q, dtype=np.float64)
        if q.shape != (7,) or not np.isfinite(q).all():
            raise InputError(f"--home takes seven joint positions [rad], not {self.home_q}")
        for joint, (value, low, high) in enumerate(zip(q, Q_MIN, Q_MAX, strict=True), start=1):
            if not low <= value <= high:
                raise InputError(
                    f"--home: joint {joint} at {value:g} rad; allowed: {low:g} to {high:g}"
                )
        (x0, x1), (y0, y1) = self.x, self.y
        given = f"--workspace: x {x0:g} to {x1:g}, y {y0:g} to {y1:g} m"
        if not all(math.isfinite(value) for value in (x0, x1, y0, y1)):
            raise InputError(f"{given} is not finite")
        if not (x0 < x1 and y0 < y1):
            raise InputError(f"{given}; give the lower end first: X0 X1 Y0 Y1")
        width, length = x1 - x0, y1 - y0
        if not abs(length / (2.0 * width) - 1.0) <= _SQUARE:
            raise InputError(
                f"{given} is {width:.4g} x {length:.4g} m; it must be twice as long along y as "
                f"along x, {2 * width:.4g} m, as its pictures are"
            )
        if not _WIDTH[0] - _ROUNDING <= width <= _WIDTH[1] + _ROUNDING:
            raise InputError(
                f"{given} is {width:.4g} m along x; allowed: {_WIDTH[0]:g} to {_WIDTH[1]:g} m"
            )
        far = max(math.hypot(x, y) for x in self.x for y in self.y)
        if not (x0 > 0.0 and far <= _REACH):
            raise InputError(
                f"{given}: a corner is {far:.2f} m from the base's axis, which reaches {_REACH} m "
                "forwards; move it nearer"
            )

    @property
    def view(self) -> TopDownView:
        """The workspace from above; its pixels are square to rounding."""
        width = self.x[1] - self.x[0]
        middle = 0.5 * (self.y[0] + self.y[1])
        return TopDownView(x=self.x, y=(middle - width, middle + width))

    def limits(self, table: TablePlane, **others: Any) -> SafetyLimits:
        """Return the safety limits of this workspace above a table; `others` are theirs, too."""
        return SafetyLimits(table=table, x=self.x, y=self.y, **others)

    def difference(self, other: Workplace) -> str | None:
        """Return "this, not that" of what differs; None where both are the same."""
        if not self.has_home_of(other):
            return f"{self.home_text()}, not {other.home_text()}"
        if not self.has_workspace_of(other):
            return f"{self.workspace_text()}, not {other.workspace_text()}"
        return None

    def has_home_of(self, other: Workplace) -> bool:
        """Whether both have the same home pose, as far as people type digits."""
        return bool(np.abs(np.subtract(self.home_q, other.home_q)).max() <= _SAME_Q)

    def has_workspace_of(self, other: Workplace) -> bool:
        """Whether both have the same workspace, as far as people type digits."""
        ends = np.subtract((*self.x, *self.y), (*other.x, *other.y))
        return bool(np.abs(ends).max() <= _SAME_M)

    def home_text(self) -> str:
        """Return the home pose as the flag takes it."""
        return "--home " + " ".join(f"{value + 0.0:.4f}" for value in self.home_q)

    def workspace_text(self) -> str:
        """Return the workspace as the flag takes it."""
        return "--workspace " + " ".join(f"{value:.6g}" for value in (*self.x, *self.y))

    def with_flags(
        self,
        home: tuple[float, ...] | None = None,
        workspace: tuple[float, float, float, float] | None = None,
    ) -> Workplace:
        """Return this with what the flags `--home` and `--workspace` say instead, if they do."""
        home_q = self.home_q if home is None else home
        x, y = (self.x, self.y) if workspace is None else _halves(workspace)
        return replace(self, home_q=home_q, x=x, y=y)

    def save(self, setup: Path) -> None:
        """Write the setup's file, whole or not at all; InputError where it cannot be written."""
        record = {"home_q": list(self.home_q), "workspace": [*self.x, *self.y]}
        write_json(setup / _FILE, {"schema": 1, **record})

    @classmethod
    def load(cls, setup: Path) -> Workplace | None:
        """Return what is stored in a setup's folder, None where nothing is.

        Raises:
            InputError: the file is damaged, or holds what cannot be
        """
        path = setup / _FILE
        if not path.is_file():
            return None
        record = read_json(path, what="workplace", schema=1)
        q = read_numbers(record, "home_q", (7,), what=f"workplace {path}")
        ends = read_numbers(record, "workspace", (4,), what=f"workplace {path}")
        x, y = _halves(tuple(ends.tolist()))
        try:
            return cls(home_q=tuple(q.tolist()), x=x, y=y)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error


def _halves(ends: tuple[float, ...]) -> tuple[tuple[float, float], tuple[float, float]]:
    x0, x1, y0, y1 = ends
    return (x0, x1), (y0, y1)
