"""fold-fabric-1: fold a flat fabric along its diagonal, from a free start.

Definition (ours). A fabric of 0.2 m and 10 x 10 vertices lies flat on the table, shifted by 5 cm
(standard deviation along each axis) and turned at random. The goal is the fabric folded along a
diagonal: one corner lies on the opposite one. The tip is free at first and has 60 steps of 50 ms,
at up to 1 m/s. The episode ends as soon as it was solved for five steps.

Source: Fold-Cloth-1 of DaXBench (Chen et al., ICLR 2023). The score is exp(-10 D), D the two-sided
chamfer distance to the goal with the root mean square over x, y, z of every pair, here the mean of
both sides, without DaXBench's factor 0.99 a step.

Differences. DaXBench's cloth has 16 x 32 particles on 0.2 x 0.4 m, simulated as springs under a
gravity of 0.5; its goals were folded by hand; its three actions are whole picks and places of 40
moves each. Solved is ours: vertices lie within 15 mm of their places on average, where each has its
own, and none higher than 30 mm, so that no fold counts while it is held in the air. Numbers of
theirs and of ours never belong into one row of a table without that sentence.

Numbers to beat: a score of 0.40 (DaXBench's PPO), 0.82 by imitation (ILD). On our fabric the score
says little: half as long as DaXBench's, it has 0.92 before it is touched, and 0.98 when folded. So
the measure here is the mean distance of the vertices, 52 mm at first; 15 mm is the aim.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cloth import Cloth, ClothConfig, add_cloth, cloth_sheet
from ..tasks.cloth_physics import FABRIC, FABRIC_PRIMITIVE, FABRIC_SOLVER, FABRIC_SPEED
from ..tasks.demonstrators import pick_place
from ..tasks.fabric_shape import fold_corner
from ..tasks.free_space import FreeSpace
from ..tasks.ground_truth import Row, Rows
from ..tasks.losses import lengths
from ..tasks.task import Action, Layout, Snapshot, Stage
from .control_task import ControlTask

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["CARRY_STEPS", "FoldFabric1"]

_SHIFT = 0.05
"""Spread of the start along x and y [m], as DaXBench's."""
CARRY_STEPS = 60
"""Control steps of a pick of a vertex, its way, and the way up again."""
_CORNER = 0
"""The vertex that is to lie on the opposite one."""
_FOLD_HEIGHT = 0.03
"""Of a fabric that lies in folds, whose crease stands up to 20 mm [m]."""


class FoldFabric1(ControlTask):
    """One corner onto the opposite one."""

    name = "fold-fabric-1"
    instruction = "Fold the fabric along its diagonal."
    stages = (Stage(lift=0.10, speed=FABRIC_SPEED),)
    solver = FABRIC_SOLVER
    primitive = FABRIC_PRIMITIVE
    success_score = 1.0
    ground_truth_rows: ClassVar[Rows] = ((Row.POINT, 200),)
    objects = ("fabric",)
    horizon = 60
    ends_when_solved = True

    fabric: ClassVar[ClothConfig] = FABRIC
    tolerance: ClassVar[float] = 0.015
    """Mean distance [m] of the vertices from their places at which it is solved."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cloth]:
        """Add the fabric, flat in the middle of the table."""
        return (add_cloth(builder, self.fabric, cloth_sheet(self.fabric, (0.5, 0.0))),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A flat fabric; targets (100, 3): its vertices once it is folded."""
        x, y = rng.normal((0.5, 0.0), _SHIFT)
        sheet = cloth_sheet(self.fabric, (x, y), yaw=rng.uniform(-np.pi, np.pi))
        goal = self.folded(sheet)
        return Layout(particle_q=sheet, body_q=np.zeros((0, 7)), targets=goal, calm=True)

    def folded(self, sheet: np.ndarray) -> np.ndarray:
        """The goal (100, 3) [m] of a flat sheet."""
        half = float(np.linalg.norm(sheet[-1] - sheet[_CORNER])) / 2
        return fold_corner(sheet, _CORNER, half, 2 * self.fabric.radius)

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Mean distances [m] of the vertices from their places."""
        goals = particle_q.new_tensor(np.stack([layout.targets for layout in layouts]))
        return lengths(particle_q - goals).mean(-1)

    def away(self, layout: Layout, snapshot: Snapshot) -> float:
        """Mean distance of the vertices from their places [m]."""
        return float(np.linalg.norm(snapshot.particle_q - layout.targets, axis=1).mean())

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """DaXBench's exp(-10 D)."""
        pairs = np.linalg.norm(snapshot.particle_q[:, None] - layout.targets, axis=2) / np.sqrt(3)
        return float(np.exp(-5 * (pairs.min(axis=0).mean() + pairs.min(axis=1).mean())))

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the fabric lies, its vertices within 15 mm of their places on average."""
        return self.away(layout, snapshot) < self.tolerance and self.rests(snapshot)

    @property
    def greatest_height(self) -> float:
        """Greatest height of a vertex with which the task is solved [m]."""
        return _FOLD_HEIGHT

    @property
    def carries(self) -> int:
        """How many carries of corners demonstrate it; 0: `demonstrate` does, as of other tasks."""
        return self.horizon // CARRY_STEPS

    def rests(self, snapshot: Snapshot) -> bool:
        """Whether no part of the fabric is held up."""
        return bool(snapshot.particle_q[:, 2].max() < self.greatest_height)

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Put the corner onto the opposite one; None once it is done."""
        if self.solved(layout, snapshot):
            return None
        pick, place = snapshot.particle_q[_CORNER, :2], layout.targets[_CORNER, :2]
        return pick_place(pick, place, stage=self.stages[0])

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(600,): x, y, z of every vertex, then of the places of all."""
        return np.concatenate([snapshot.particle_q, layout.targets]).astype(np.float32).ravel()
