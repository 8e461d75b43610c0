"""gather: sweep three boxes together with a cable, one end of which is pinned.

Definition (ours). A cable of 45 beads, 0.62 m, lies straight along y. Its first bead is pinned to
the table, the tip holds the last one and keeps it. Three boxes of 5 cm stand on one side of it. The
tip has 100 steps of 50 ms, at up to 1 m/s. Solved: the three distances between the boxes' centres
sum to at most `together` times the edge.

Source: Gathering of DLO-Lab. The cost is its own, with lengths in the source's metres (see
`held_cable`): the three distances between the objects, a tenth of their distances from the nearest
vertex of the rope, and 100 times what either end is nearer than 10 cm to the nearest object. The
last term is naive: it also forbids to reach over the objects, and makes a step worth nothing for an
approach. It is kept, for gradients fail on it there.

Differences. DLO-Lab has two arms, a rope of elastic rods, a soft sphere, a bunny and a cylinder,
and 100 steps of 20 ms or more; its rope's ends are beads 1 and 43. What it calls success is not
told. Numbers of theirs and of ours never belong into one row of a table without that sentence.

Numbers to beat: a return of 47.84 (DLO-Lab's CMA-ES, 100 % there), 40.48 by gradients (0 %). A rope
that stands still has about 40 there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box, BoxConfig, BoxPart, add_box
from ..objects.cable import Cable, CableConfig, add_cable, cable_line
from ..objects.colors import GREEN, RED, YELLOW
from ..support.quaternion import quat_from_yaw
from ..tasks.free_space import FreeSpace
from ..tasks.losses import lengths
from ..tasks.task import Layout, Snapshot
from .held_cable import HeldCable, pin

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["Gather"]

_EDGE = 0.05
_PINNED = (0.62, -0.31)
"""Where the pinned bead lies on average [m]."""
_BOXES = ((-0.057, 0.283), (-0.106, 0.460), (-0.127, 0.163))
"""Of the boxes from there [m]: the source's sphere, bunny and cylinder."""
_SHIFT = 0.01
"""Spread of the pinned bead along x and y [m]."""
_ALONG = 0.018
"""Most that a box is shifted along the cable [m]: 2.5 cm of the source."""
_CLEAR = 0.1
"""Distance that ends have to keep from objects, in the source's metres."""


class Gather(HeldCable):
    """Three boxes together."""

    name = "gather"
    instruction = "Sweep the three boxes together with the cable."
    success_score = 1.0
    ground_truth_size = 3 * 48
    objects = ("cable", "box", "box", "box")
    held_particle = 44

    cable: ClassVar[CableConfig] = CableConfig(beads=45)
    together: ClassVar[float] = 4.5
    """Sum of the distances between the boxes at which it is solved, in edges; three in a row, face
    to face, have 4."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable | Box, ...]:
        """Add the cable and the boxes."""
        line = cable_line(self.cable, _PINNED, (_PINNED[0], 1.0))
        cable = add_cable(builder, self.cable, line)
        pin(builder, cable, 0)
        boxes = [
            add_box(
                builder,
                BoxConfig(parts=(BoxPart((_EDGE, _EDGE, _EDGE)),), mass=0.05, color=color),
                (_PINNED[0] + x, _PINNED[1] + y, _EDGE / 2),
            )
            for (x, y), color in zip(_BOXES, (RED, GREEN, YELLOW), strict=True)
        ]
        return (cable, *boxes)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The cable straight, the boxes beside it; targets (1, 3): the pinned bead."""
        x, y = rng.normal(_PINNED, _SHIFT)
        beads = cable_line(self.cable, (x, y), (x, y + 1.0))
        along = rng.uniform(-_ALONG, _ALONG, len(_BOXES))
        yaws = rng.uniform(-np.pi, np.pi, len(_BOXES))
        boxes = [
            [x + dx, y + dy + shift, _EDGE / 2, *quat_from_yaw(yaw)]
            for (dx, dy), shift, yaw in zip(_BOXES, along, yaws, strict=True)
        ]
        return Layout(particle_q=beads, body_q=np.array(boxes), targets=beads[:1])

    @property
    def solved_first(self) -> bool:
        """True: the cost of boxes that stand together has more terms than their distances."""
        return True

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """DLO-Lab's cost of every state (W,), without unit; lengths are in its metres."""
        rope, boxes = self.in_source(particle_q), self.in_source(body_q[..., :3])
        away = lengths(rope[:, :, None] - boxes[:, None])  # (W, P, 3)
        ends = away[:, [0, -1]].amin(-1)
        near = (_CLEAR - ends).clamp(min=0.0).sum(-1)
        return self._spread(boxes) + 0.1 * away.amin(1).sum(-1) + 100 * near

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the boxes stand together."""
        import torch

        boxes = torch.from_numpy(snapshot.body_q[None, :, :3].astype(float))
        return bool(self._spread(boxes)[0] <= self.together * _EDGE)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(144,): x, y, z of every bead, then of the boxes."""
        points = np.concatenate([snapshot.particle_q, snapshot.body_q[:, :3]])
        return points.astype(np.float32).ravel()

    @staticmethod
    def _spread(boxes: Tensor) -> Tensor:
        """Sum (W,) of the distances between three points (W, 3, 3)."""
        return lengths(boxes - boxes.roll(1, 1)).sum(-1)
