"""fold-fabric-3: fold three corners of a flat fabric to its middle, from a free start.

Definition (ours). Start, tip and fabric are those of `fold-fabric-1`. In the goal three corners are
turned over, each to 14 mm from the middle. The tip has 180 steps of 50 ms, 60 a fold. The episode
ends as soon as it was solved for five steps: when the vertices lie within 6 mm of their places on
average, where a flat fabric has 20 mm and one with two of the folds 7, each of the three corners
within 25 mm of its place, and nothing higher than 30 mm.

Source: Fold-Cloth-3 of DaXBench (Chen et al., ICLR 2023), with the score of `fold-fabric-1`.

Differences. As for `fold-fabric-1`; which three folds DaXBench's goal has, made by hand, is not
told in numbers, and its four actions are whole picks and places. Folds that lie on each other are
left out: our fabric is as stiff as canvas and 6 mm thick, and four layers of it do not lie down.
Solved is ours. Numbers of theirs and of ours never belong into one row of a table without that
sentence.

Numbers to beat: a score of 0.22 (DaXBench's SHAC; PPO 0.21), 0.82 by imitation (ILD). On our
fabric, half as long as DaXBench's, the score is high before it is touched; the mean distance of the
vertices is the measure here.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..tasks.demonstrators import pick_place
from ..tasks.fabric_shape import fold_over
from ..tasks.task import Action, Layout, Snapshot
from .fold_fabric import FoldFabric1

__all__ = ["FoldFabric3"]

_SHARE = 0.9
"""Share of the way to the middle that a corner is folded."""


class FoldFabric3(FoldFabric1):
    """Three corners to the middle."""

    name = "fold-fabric-3"
    instruction = "Fold three corners of the fabric to its middle."
    horizon = 180

    tolerance: ClassVar[float] = 0.006
    folds: ClassVar[tuple[int, ...]] = (0, 9, 90)
    """Vertices at the corners that are folded."""
    corner_tolerance: ClassVar[float] = 0.025
    """Distance [m] of these from their places at which it is solved."""

    def folded(self, sheet: np.ndarray) -> np.ndarray:
        """The goal (100, 3) [m] of a flat sheet."""
        goal, middle = sheet, sheet.mean(axis=0)
        for corner in self.folds:
            place = sheet[corner] + _SHARE * (middle - sheet[corner])
            goal = fold_over(goal, sheet[corner], place, 2 * self.fabric.radius)
        return goal

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the vertices, and the three corners, lie where they belong."""
        corners = self._corners(layout, snapshot)
        return super().solved(layout, snapshot) and bool((corners < self.corner_tolerance).all())

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The next fold; None once all are done."""
        away = self._corners(layout, snapshot)
        for corner, far in zip(self.folds, away, strict=True):
            if far >= self.corner_tolerance:
                pick, place = snapshot.particle_q[corner, :2], layout.targets[corner, :2]
                return pick_place(pick, place, stage=self.stages[0])
        return None

    def _corners(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Distances (3,) of the corners from their places [m]."""
        at = list(self.folds)
        return np.asarray(np.linalg.norm(snapshot.particle_q[at] - layout.targets[at], axis=1))
