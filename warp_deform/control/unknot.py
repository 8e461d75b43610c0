"""unknot: untie a loose overhand knot in a cable, one end of which is weighed down.

Definition (ours). A cable of 50 beads a diameter apart, 0.7 m, lies in a loose overhand knot. Its
third bead is weighed down where it lies. The tip holds bead 37, which lies in the knot between the
last two crossings, and keeps it. It has 100 steps of 50 ms, at up to 1 m/s. Solved: the cable has
no knot, see `knots.untied`.

Source: Unknotting of DLO-Lab. The cost is its own, with lengths in the source's metres (see
`held_cable`): the average crossing number, of midpoints of links and softened by 2 cm, and 100
times the squares of what two links that are no neighbours are nearer than 4 cm.

Strands must not pass through each other, by which a knot that is drawn tight would come untied.
Here the cable would stretch first: beads touch before strands cross, an overlap is undone at once
(`recovery`), and a link of more than 1.15 times its length makes a guard fire, which ends the
episode. For one link to go through another between beads that do not overlap, the squares of their
lengths have to sum to four spacings' squares. A held bead that is led at the weight pushes it
aside.

Differences. DLO-Lab has two arms, which hold vertices 2 and 37 of a rope of elastic rods, in a knot
from a file, with 100 steps of 20 ms or more; radius, mass and stiffness vary there, and an episode
ends at a stretch of 5 % between the arms. What the paper calls success is not told; a script beside
its code takes a crossing number below 0.1. Numbers of theirs and of ours never belong into one row
of a table without these sentences.

Numbers to beat: a return of 57.21 (DLO-Lab's CMA-ES, 93 % there), 46.30 by gradients (80 %).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cable import Cable, CableConfig, add_cable
from ..tasks.free_space import FreeSpace
from ..tasks.losses import lengths
from ..tasks.task import Layout, Snapshot
from ..xpbd.guards import GuardLimits
from .held_cable import CABLE, HeldCable, weigh_down
from .knots import overhand_knot, untied

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["UNTIE", "Unknot"]

UNTIE = np.array(
    [[0.0, 0.0, 0.3]] * 2
    + [[0.1, 0.1, 0.0]] * 2
    + [[0.1, 0.1, -0.05]]
    + [[0.0, 0.1, -0.15]] * 2
    + [[0.0, 0.1, -0.075], [0.0, 0.0, -0.075], [0.0, 0.0, 0.0]]
)
"""A plan of `SmoothPlayer` that unties: up, so that the end slips out under the strand over it, and
away from the heavy end."""

_HEAVY = (0.45, -0.35)
"""Where the heavy bead lies on average [m]."""
_SHIFT = 0.01
"""Spread of the heavy bead along x and y [m]."""
_TURN = 0.1
"""Spread of the knot's direction [rad]."""
_LOOPS = (1.4, 1.7)
"""Least and greatest size of the knot's loops, see `overhand_knot`."""
_SOFT, _APART = 0.02, 0.04
"""What softens the crossing number, and the distance of links that costs nothing, in the source's
metres."""


class Unknot(HeldCable):
    """The knot untied."""

    name = "unknot"
    instruction = "Untie the knot in the cable."
    success_score = 1.0
    ground_truth_size = 3 * 50
    solver = replace(CABLE, recovery=10.0, limits=GuardLimits(stretch=1.15))
    held_particle = 37

    cable: ClassVar[CableConfig] = CableConfig(beads=50, radius=CableConfig().spacing / 2)
    heavy: ClassVar[int] = 2

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable, ...]:
        """Add the cable."""
        cable = add_cable(builder, self.cable, self._knot(1.5, 0.0))
        weigh_down(builder, cable, self.heavy)
        return (cable,)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The cable in a knot; targets (1, 3): the heavy bead."""
        beads = self._knot(rng.uniform(*_LOOPS), rng.normal(0.0, _TURN))
        beads[:, :2] += rng.normal(0.0, _SHIFT, 2)
        return Layout(particle_q=beads, body_q=np.zeros((0, 7)), targets=beads[[self.heavy]])

    def _knot(self, loops: float, turn: float) -> np.ndarray:
        """Beads (50, 3) [m], from the heavy end on along y, which is turned by `turn` [rad]."""
        beads = overhand_knot(self.cable.beads, self.cable.spacing, loops)
        along, across = (
            np.array([-np.sin(turn), np.cos(turn)]),
            np.array([np.cos(turn), np.sin(turn)]),
        )
        beads[:, :2] = beads[:, 1:2] * across - beads[:, :1] * along
        beads[:, :2] += _HEAVY - beads[self.heavy, :2]
        return beads

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """DLO-Lab's cost of every state (W,), without unit; lengths are in its metres."""
        import torch

        rope = self.in_source(particle_q)
        links, middles = rope.diff(dim=1), (rope[:, 1:] + rope[:, :-1]) / 2
        i, j = torch.triu_indices(links.shape[1], links.shape[1], 2)
        away = middles[:, i] - middles[:, j]
        volumes = (away * torch.linalg.cross(links[:, i], links[:, j])).sum(-1).abs()
        softened = (away.square().sum(-1) + _SOFT**2) ** 1.5
        near = (_APART - lengths(away)).clamp(min=0.0).square()
        # both orders of every pair
        return 2.0 * (volumes / softened / (4 * np.pi) + 100.0 * near).sum(-1)

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the cable has no knot."""
        return untied(snapshot.particle_q)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(150,): x, y, z of every bead."""
        return snapshot.particle_q.astype(np.float32).ravel()
