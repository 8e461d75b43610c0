"""What makes a simulated state invalid, by name; nothing here repairs anything."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from ..errors import WarpDeformError
from ..support.checked import Interval, check_fields

__all__ = ["GuardLimits", "PhysicsError", "Problem", "ProblemKind", "WatchValues"]


class ProblemKind(Enum):
    """Why a state cannot be trusted."""

    NONFINITE = "non-finite"
    STRETCH = "stretch"
    PENETRATION = "penetration"
    BOX_PENETRATION = "box under the table"
    BOX_OVERLAP = "boxes inside each other"
    OVERFLOW = "contact-buffer overflow"
    SPEED_CLAMP = "speed clamp"


@dataclass(frozen=True)
class Problem:
    """One guard that fired in one world, with the value it saw and the limit it holds."""

    kind: ProblemKind
    world: int
    value: float
    limit: float

    def __str__(self) -> str:
        return f"{self.kind.value} in world {self.world}: {self.value:.4g} (limit {self.limit:.4g})"


@dataclass(frozen=True, kw_only=True)
class GuardLimits:
    """Limits of the guards."""

    stretch: float = 1.5
    """Longest link or edge over its rest length; cables peak at 1.1 to 1.2 when dragged. Bending
    springs of fabrics do not count."""
    depth: float = 0.01
    """Deepest that a particle's centre may be under the table [m]."""
    box_depth: float = 0.005
    """Deepest that a corner of a box may be under the table [m]; what lands at 3 m/s gets 1 mm
    deep for a moment, what lies on it in towers 0.05 mm."""
    box_overlap: float = 0.2
    """Deepest that boxes of two bodies may lie in each other, as a share of the shortest side of
    the two: 1 where boxes of one size coincide, however thin. Towers reach 0.001, a 4 cm cube that
    lands on a plate of 5 mm at 3 m/s 0.04, with 30 times the other's mass 0.08."""
    clamped_steps: int = 120
    """Substeps of one launch in which the speed clamp may act (0.1 s at the default substep)."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            dict.fromkeys(
                ("stretch", "depth", "box_depth", "box_overlap", "clamped_steps"),
                Interval(low=0.0, infinite=True),
            ),
        )


@dataclass(frozen=True)
class WatchValues:
    """Worst values of one launch in one world."""

    steps: int
    nonfinite: bool
    stretch: float
    depth: float
    box_depth: float
    box_overlap: float
    clamped: int
    overflow: int

    def problems(self, world: int, limits: GuardLimits) -> tuple[Problem, ...]:
        """The guards that these values violate."""
        problems = []
        for bad, kind, value, limit in (
            (self.nonfinite, ProblemKind.NONFINITE, float("nan"), 0.0),
            (self.stretch > limits.stretch, ProblemKind.STRETCH, self.stretch, limits.stretch),
            (self.depth > limits.depth, ProblemKind.PENETRATION, self.depth, limits.depth),
            (
                self.box_depth > limits.box_depth,
                ProblemKind.BOX_PENETRATION,
                self.box_depth,
                limits.box_depth,
            ),
            (
                self.box_overlap > limits.box_overlap,
                ProblemKind.BOX_OVERLAP,
                self.box_overlap,
                limits.box_overlap,
            ),
            (self.overflow > 0, ProblemKind.OVERFLOW, self.overflow, 0),
            (
                self.clamped > limits.clamped_steps,
                ProblemKind.SPEED_CLAMP,
                self.clamped,
                limits.clamped_steps,
            ),
        ):
            if bad:
                problems.append(Problem(kind, world, value, limit))
        return tuple(problems)


class PhysicsError(WarpDeformError):
    """A guard fired. `problems` names every cause; `bundle` reproduces it, when one was written."""

    def __init__(self, problems: tuple[Problem, ...], bundle: Path | None = None) -> None:
        where = (
            f"; reproduce it with warp_deform.solver.replay_bundle({str(bundle)!r})"
            if bundle
            else ""
        )
        super().__init__("; ".join(map(str, problems)) + where)
        self.problems = problems
        self.bundle = bundle

    def __reduce__(self) -> tuple[type[PhysicsError], tuple[tuple[Problem, ...], Path | None]]:
        """Cross processes whole: an exception is otherwise made anew from its message."""
        return type(self), (self.problems, self.bundle)
