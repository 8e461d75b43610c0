"""cable-shape and cable-shape-notarget: lay a cable along two to four sides of a rectangle.

Source: Seita et al., ICRA 2021, appendix on cable-shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cable import Cable, CableConfig, add_cable, cable_line
from ..objects.zone import segment_zone
from .cable_physics import CABLE_GRADIENT_DAMPING, CABLE_SOLVER, CABLE_STAGE
from .demonstrators import met_particle, pick_place, visible_point
from .free_space import FreeSpace
from .ground_truth import Row, Rows, pose_rows
from .losses import mean_distance
from .metrics import share_in_zone, wrap_angle
from .target_shapes import chain_yaw, sample_shape, to_world
from .task import Action, Layout, Snapshot, Task

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["CableShape", "CableShapeNotarget"]

_SETTLE_SECONDS = 2.0
_GOAL_SETTLE_SECONDS = 1.0
_STACK_NOISE = 0.001
"""Spread of the stacked beads along x and y [m]; a perfect stack of spheres would not fall."""


class CableShape(Task):
    """Every one of 24 beads has to lie on the drawn shape.

    Deliberate differences from the original: beads are spheres, so the stack that falls into a heap
    is stacked with 1 mm of noise; a bead's yaw is the angle of the chain's tangent; a pick off the
    bead's centre is made up for in the world's frame, not in that of the rolling bead.
    """

    name = "cable-shape"
    instruction = "Lay the cable along the drawn sides."
    version = 2
    stages = (CABLE_STAGE,)
    solver = CABLE_SOLVER
    gradient_damping = CABLE_GRADIENT_DAMPING
    success_score = 1.0
    ground_truth_rows: ClassVar[Rows] = ((Row.POSE, 1), (Row.BEAD, 48))
    objects = ("cable",)
    # From the white end on, every target turns to the same side: that says which end goes where.
    mirrors = False

    cable: ClassVar[CableConfig] = CableConfig()
    sides: ClassVar[tuple[int, ...]] = (2, 3, 4)
    """Numbers of sides that a target may have."""
    visible: ClassVar[bool] = True
    """Whether the target is drawn; what is drawn also keeps the start away."""
    tolerance: ClassVar[float] = 3.5 * 0.005
    """A bead nearer than this to a target is in the zone [m]."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable]:
        """Add the cable, straight along the table."""
        return (add_cable(builder, self.cable, cable_line(self.cable, (0.5, -0.17), (0.5, 0.17))),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A target that fits the table at any yaw, and a stack of beads about to fall."""
        length = self.cable.length
        x, y, yaw = space.sample(rng, length, length, extent=length / 2)
        frame = np.array([x, y, wrap_angle(yaw)])
        shape = sample_shape(rng, self.sides, self.cable.beads)
        zone = segment_zone(to_world(shape.outline(self.cable), frame))
        if self.visible:
            space = space.occupy_quads(zone.corners)
        x, y, _ = space.sample(rng, length / 10, length / 10)
        height = (np.arange(self.cable.beads) + 1) * self.cable.spacing
        xy = rng.normal([x, y], _STACK_NOISE, (self.cable.beads, 2))
        return Layout(
            particle_q=np.column_stack([xy, height]),
            body_q=np.zeros((0, 7)),
            targets=to_world(shape.targets(self.cable), frame),
            zones=(zone,) if self.visible else (),
            settle_seconds=_SETTLE_SECONDS,
            frame=frame,
        )

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Share of the beads that are in the zone; which bead lies where does not matter."""
        return share_in_zone(snapshot.particle_q, layout.targets, self.tolerance)

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Move the visible bead that is farthest from its own target onto it."""
        return next((move for _, move in self._moves(layout, snapshot, rng)), None)

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The first such move whose pick takes that bead, not one that leans over it."""
        for bead, move in self._moves(layout, snapshot, rng):
            if met_particle(move[:2], snapshot, self.primitive) == bead:
                return move
        return None

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """The farthest visible beads to their targets, with the cable either way round."""
        drawn: list[Action] = []
        for turned in (False, True):
            moves = self._moves(layout, snapshot, rng, turned=turned)
            drawn += [move for _, move in itertools.islice(moves, (count + 1) // 2)]
        return drawn[:count]

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """Share in the zone, less the beads' mean distance with the cable the better way round."""
        ways = np.stack([layout.targets, layout.targets[::-1]])
        distances = np.linalg.norm(snapshot.particle_q[:, :2] - ways, axis=2).mean(axis=1)
        return self.score(layout, snapshot) - float(distances.min()) / self.cable.length

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Mean distances [m] of the beads from their targets, the cable the better way round."""
        forwards = np.arange(self.cable.beads)
        maps = np.stack([forwards, forwards[::-1]])
        targets = np.stack([layout.targets for layout in layouts])
        return mean_distance(particle_q[..., :2], targets, maps)

    def _moves(
        self,
        layout: Layout,
        snapshot: Snapshot,
        rng: np.random.Generator,
        *,
        turned: bool = False,
    ) -> Iterator[tuple[int, Action]]:
        """Visible beads and how to move each onto its own target, the farthest from it first.

        Args:
            turned: the last bead's target is the first
        """
        targets = layout.targets[::-1] if turned else layout.targets
        distances = np.linalg.norm(
            snapshot.particle_q - np.column_stack([targets, np.zeros(self.cable.beads)]), axis=1
        )
        segments = snapshot.segments[len(layout.zones)]
        for bead in np.argsort(-distances, kind="stable"):
            pick = visible_point(snapshot.images.segmentation == segments[bead], rng)
            if pick is not None:
                offset = pick - snapshot.particle_q[bead, :2]
                yield int(bead), pick_place(pick, targets[bead] + offset, stage=self.stages[0])

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(147,): the target's centre, then bead 0, its target, bead 1, its target, ...

        Each is x, y, -yaw / 15; a target's yaw is 0, the centre's that of the rectangle.
        """
        if layout.frame is None:
            raise ValueError(f"{self.name} needs the frame of its targets")
        centre = pose_rows(layout.frame, layout.frame[2])
        targets = pose_rows(layout.targets, 0.0)
        pairs = np.stack([self._chain_rows(snapshot.particle_q), targets], axis=1)
        return np.concatenate([centre.ravel(), pairs.ravel()])

    def _chain_rows(self, points: np.ndarray) -> np.ndarray:
        return pose_rows(points, chain_yaw(points, closed=False))


class CableShapeNotarget(CableShape):
    """cable-shape with the target in a goal image instead of on the table."""

    name = "cable-shape-notarget"
    instruction = "Lay the cable as in the goal picture."
    goal_conditioned = True
    ground_truth_rows = ((Row.BEAD, 48),)
    visible = False
    mirrors = True  # the goal's picture shows both ends

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(144,): x, y, -yaw / 15 of every bead, then the same of the goal's beads."""
        rows = [self._chain_rows(snapshot.particle_q), self._chain_rows(layout.targets)]
        return np.concatenate(rows).ravel()

    def goal_layout(self, layout: Layout) -> Layout:
        """The cable laid on the targets, which settles to the links' true lengths."""
        height = np.full(self.cable.beads, self.cable.radius)
        return replace(
            layout,
            particle_q=np.column_stack([layout.targets, height]),
            settle_seconds=_GOAL_SETTLE_SECONDS,
            calm=True,
        )

    def goal_targets(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Where the beads lie (24, 2) [m]."""
        return np.array(snapshot.particle_q[:, :2], dtype=float)
