"""cable-ring and cable-ring-notarget: open a crumpled ring of beads.

Source: Seita et al., ICRA 2021, appendix on cable-ring.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cable import Cable, RingConfig, add_cable, cable_ring
from ..objects.push import Push
from ..objects.zone import ring_zone
from ..rendering.pixels import BOUNDS
from .cable_physics import CABLE_SOLVER, CABLE_STAGE
from .demonstrators import farthest_bead, pick_place, ring_maps
from .free_space import FreeSpace
from .ground_truth import pose_rows
from .metrics import hull_area
from .shapes import chain_yaw
from .task import Action, Layout, Snapshot, Task

if TYPE_CHECKING:
    import newton

__all__ = ["CableRing", "CableRingNotarget"]

# The original pushes one bead with 40 N up and up to 20 N along x and y, 20 times before physics
# runs again. Spread over 0.25 s, the forces below crumple the ring as far (hull area 0.3 of the
# circle) and leave it on the table in 98 of 100 starts.
_PUSH_UP = 25.0  # [N]
_PUSH_SIDEWAYS = 5.0  # [N]
_PUSH_SECONDS = 0.25
_SETTLE_SECONDS = 2.0
_TABLE_CENTRE = np.array(BOUNDS[:2]).mean(axis=1)


class CableRing(Task):
    """A ring of 32 beads has to span 0.75 of the circle it was; 32 marks show that circle.

    Deliberate differences from the original: beads are spheres; the perturbation is a bounded force
    over simulated time, towards the table's centre so that the ring stays on the table; the score
    is a share of the circle's area instead of an area.
    """

    name = "cable-ring"
    stages = (CABLE_STAGE,)
    solver = CABLE_SOLVER
    success_score = 0.75
    ground_truth_size = 192
    objects = ("cable",)

    cable: ClassVar[RingConfig] = RingConfig()
    visible: ClassVar[bool] = True
    """Whether the targets are drawn."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable]:
        """Add the ring in the middle of the table."""
        return (add_cable(builder, self.cable, cable_ring(self.cable, tuple(_TABLE_CENTRE))),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A round ring, with room for it to move by half its radius, and the push that follows."""
        room = 3 * self.cable.ring_radius
        x, y, _ = space.sample(rng, room, room, extent=room / 2)
        beads = cable_ring(self.cable, (x, y))
        targets = beads[:, :2].copy()
        return Layout(
            particle_q=beads,
            body_q=np.zeros((0, 7)),
            targets=targets,
            zones=(ring_zone(targets),) if self.visible else (),
            pushes=(self._sample_push(rng, np.array([x, y])),),
            settle_seconds=_SETTLE_SECONDS,
        )

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Area of the beads' convex hull over the circle's; at most 1 even if links stretch."""
        circle = math.pi * self.cable.ring_radius**2
        return float(np.minimum(hull_area(snapshot.particle_q[:, :2]) / circle, 1.0))  # keeps nan

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Move the bead that is farthest from its target under the best of 64 maps."""
        targets = np.column_stack([layout.targets, np.zeros(self.cable.beads)])
        maps = ring_maps(self.cable.beads, reversals=True)
        bead, target = farthest_bead(snapshot.particle_q, targets, maps)
        return pick_place(snapshot.particle_q[bead], targets[target], stage=self.stages[0])

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(192,): bead 0, its mark, bead 1, its mark, ... each x, y, -yaw / 15 (0 for marks)."""
        beads = self._bead_rows(snapshot)
        return np.stack([beads, pose_rows(layout.targets, 0.0)], axis=1).ravel()

    def _bead_rows(self, snapshot: Snapshot) -> np.ndarray:
        beads = snapshot.particle_q
        return pose_rows(beads, chain_yaw(beads, closed=True))

    def _sample_push(self, rng: np.random.Generator, centre: np.ndarray) -> Push:
        """Force on a random bead: up, and sideways into the quadrant of the table's centre."""
        bead = int(rng.integers(self.cable.beads))
        angle = rng.uniform(0.0, np.pi / 2)
        inwards = np.where(centre > _TABLE_CENTRE, -1.0, 1.0)
        sideways = _PUSH_SIDEWAYS * inwards * [np.cos(angle), np.sin(angle)]
        force = np.array([*sideways, _PUSH_UP])
        return Push(bead, force / self.cable.mass, _PUSH_SECONDS)


class CableRingNotarget(CableRing):
    """cable-ring without marks: any opened ring will do, wherever it lies."""

    name = "cable-ring-notarget"
    ground_truth_size = 96
    visible = False

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(96,): x, y, -yaw / 15 of every bead."""
        return self._bead_rows(snapshot).ravel()
