"""bag-alone-open: pull the opening of a crumpled bag apart.

Source: Seita et al., ICRA 2021, appendix on bag-alone-open.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..objects.bag import Bag, add_bag
from .bag_opening import BAG_ROWS, BagTask
from .bag_physics import OPEN
from .free_space import FreeSpace
from .task import Action, Layout, Snapshot

if TYPE_CHECKING:
    import newton

__all__ = ["BagAloneOpen"]

_ROOM = 0.2  # [m] side of the square that a bag is given


class BagAloneOpen(BagTask):
    """The beads around the opening have to span 0.70 of the circle that they were.

    Deliberate differences from the original: the beads are the shell's own vertices; the
    perturbation is a bounded impulse spread over 0.2 s; the score is a share of the circle's area
    instead of an area.
    """

    name = "bag-alone-open"
    instruction = "Open the bag."
    stages = (OPEN,)
    success_score = 0.70
    ground_truth_rows = BAG_ROWS
    objects = ("bag",)
    pushes = 12

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Bag]:
        """Add the bag."""
        return (add_bag(builder, self.bag),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A bag above the table, about to fall, and a push of one bead."""
        x, y, _ = space.sample(rng, _ROOM, _ROOM)
        return Layout(
            particle_q=self.drop(rng, x, y),
            body_q=np.zeros((0, 7)),
            targets=self.ring_targets(x, y),
            pushes=(self.push(rng, 0),),
            settle_seconds=self.settle_seconds,
        )

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Area of the hull of the beads over that of the opening at rest, at most 1."""
        return float(np.minimum(self.opening(snapshot), 1.0))  # keeps nan

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Pull the farthest bead, seen or not; give up where few beads are visible."""
        if self.hidden(layout, snapshot):
            return None
        return self.pull_farthest(layout, snapshot)

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Pull the farthest of the beads that the tip would really take."""
        return self.pull_visible(layout, snapshot)

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Pulls of several beads."""
        return self.pulls(layout, snapshot, rng, count)

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """The opening, less how far the beads are from where they should be."""
        return self.opening(snapshot) - 0.5 * self.map_distance(layout, snapshot)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(99,): x, y, -yaw / 15 of every bead, then of the bag's displacement."""
        return self.bag_rows(layout, snapshot).ravel()
