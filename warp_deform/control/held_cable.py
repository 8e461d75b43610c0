"""What ports of DLO-Lab's tasks share: a cable of which one bead is led for 100 steps.

Source: DLO-Lab (arXiv 2606.04206). Its rewards are exp(-cost), with costs of lengths in metres on a
rope whose vertices are 2 cm apart. Costs here have the same formulas, of lengths told in that
rope's metres: what is 20 mm there is one spacing here. An episode's return is the sum of the scores
of its 100 steps.

Two arms there, one here: where the source holds both ends, here one is pinned. Its two arms also
turn the rope's ends; a tip here takes no bead round its own axis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box
from ..objects.cable import Cable, CableConfig
from ..tasks.task import Action, Layout, Snapshot, Stage
from ..xpbd.config import SolverConfig
from .control_task import ControlTask
from .modes import ControlConfig

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["CABLE", "HeldCable", "fix", "pin", "weigh_down"]

_SPACING = 0.02
"""Between two vertices of the source's ropes [m]."""
CABLE = SolverConfig(
    table_friction=0.35, contact_friction=0.2, damping=1.0, max_speed=8.0, margin=0.02
)
"""Physics of a cable that is led, as in `whip`."""


def pin(builder: newton.ModelBuilder, cable: Cable, bead: int) -> None:
    """Fix a bead where it is: it has no mass, so nothing moves it."""
    builder.particle_mass[cable.particles[bead]] = 0.0


def weigh_down(builder: newton.ModelBuilder, cable: Cable, bead: int) -> None:
    """Make a bead as heavy as 10,000: no pull moves it, and what a tip leads pushes it aside.

    Between a pinned bead and a held one nothing acts, since neither has a mass to be moved.
    """
    builder.particle_mass[cable.particles[bead]] *= 1e4


def fix(builder: newton.ModelBuilder, box: Box) -> None:
    """Fix a box where it stands: it has neither mass nor inertia, so nothing moves or turns it."""
    import warp as wp

    builder.body_mass[box.body] = builder.body_inv_mass[box.body] = 0.0
    builder.body_inertia[box.body] = builder.body_inv_inertia[box.body] = wp.mat33(0.0)


class HeldCable(ControlTask):
    """A cable of which the tip holds a bead, and never lets go."""

    stages = (Stage(lift=0.04, speed=0.15),)
    solver = CABLE
    objects: ClassVar[tuple[str, ...]] = ("cable",)
    control = ControlConfig(max_speed=1.0)
    horizon = 100
    keeps_hold = True

    cable: ClassVar[CableConfig]

    @property
    def pays_on_the_way(self) -> bool:
        """Whether plans are searched for the source's return, or else for their last state."""
        return True

    def in_source(self, points: Tensor) -> Tensor:
        """Points, or lengths, in the source's metres."""
        return points * (_SPACING / self.cable.spacing)

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """The source's reward of a step, exp(-cost)."""
        return float(np.exp(-self.cost(layout, snapshot)))

    def cost(self, layout: Layout, snapshot: Snapshot) -> float:
        """The source's cost of a state: `loss`, as a number."""
        import torch

        state = (torch.from_numpy(q.astype(float)) for q in (snapshot.particle_q, snapshot.body_q))
        with torch.no_grad():
            return float(self.loss(layout, snapshot, *state))

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Any start that is not solved."""
        return not self.solved(layout, snapshot)

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """None: no pick and place does it."""
        return None
