"""What the tasks share in which all of a cable counts: the goal is where every bead is to be.

Source: the score of DaXBench (Chen et al., ICLR 2023), exp(-10 D) with D the mean over particles of
the root mean square of their distance along x, y, z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cable import CableConfig
from ..rendering.pixels import BOUNDS
from ..tasks.losses import lengths
from ..tasks.task import Action, Layout, Snapshot
from .control_task import ControlTask

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["CableGoalTask"]


class CableGoalTask(ControlTask):
    """A cable whose every bead is to be where another plan has led it."""

    cable: ClassVar[CableConfig] = CableConfig()

    def aimed_at(self, particle_q: np.ndarray) -> np.ndarray:
        """What of a state (24, 3) is the goal (n, 3) [m]."""
        return np.array(particle_q, dtype=float)

    def is_goal(self, particle_q: np.ndarray) -> bool:
        """Where all of it is over the table."""
        (x0, x1), (y0, y1) = BOUNDS[:2]
        xy = particle_q[:, :2]
        return bool(((xy > (x0, y0)) & (xy < (x1, y1))).all())

    def layout_for(self, layout: Layout, particle_q: np.ndarray) -> Layout:
        """The layout with the goal where a plan has led."""
        return replace(layout, targets=self.aimed_at(particle_q))

    def marks(self, layout: Layout) -> np.ndarray:
        """The goal itself."""
        return np.array(layout.targets, dtype=float)

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Mean over the beads of their distance from the goal [m] over sqrt(3): DaXBench's D."""
        goals = particle_q.new_tensor(np.stack([layout.targets for layout in layouts]))
        return lengths(particle_q - goals).mean(-1) / np.sqrt(3)

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """DaXBench's score, exp(-10 D)."""
        away = np.linalg.norm(snapshot.particle_q - layout.targets, axis=1).mean()
        return float(np.exp(-10 * away / np.sqrt(3)))

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Any start is."""
        return True

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """None: no pick and place swings or pushes."""
        return None
