"""wire: lead a cable between two posts and lay it there.

Definition (ours). A cable of 30 beads, 0.41 m, lies straight along y, with both posts on one side
of it. The tip holds its fourth bead and keeps it. The posts are boxes of 2.8 cm that stand fast.
The tip has 100 steps of 50 ms, at up to 1 m/s. Solved: the cable crosses the line through the posts
once, between them, at most `within` beads from its middle, and no bead is higher than they are.

Source: Wiring-post of DLO-Lab. The cost is its own, with lengths in the source's metres (see
`held_cable`): the mean distance of the beads from the nearest point of the target and of its points
from the nearest bead, the beads' mean height above 4 cm, and five times what the middle bead is
farther than 2 cm from its place.

Differences. The source's target is a shape in a file, here it is the straight line through the gap.
Its posts are cylinders of the same width and height and stand in the same places relative to the
rope, of which its arm holds the same vertex. It has 100 steps of 20 ms or more, at most 1 cm each.
What it calls success is not told. Numbers of theirs and of ours never belong into one row of a
table without that sentence.

Numbers to beat: a return of 64.3 (DLO-Lab's CMA-ES, 93 % there), 36.4 by gradients (0 %).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box, BoxConfig, BoxPart, add_box
from ..objects.cable import Cable, CableConfig, add_cable, cable_line
from ..objects.colors import GRAY
from ..tasks.free_space import FreeSpace
from ..tasks.losses import lengths
from ..tasks.task import Layout, Snapshot
from .held_cable import HeldCable, fix

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["THROUGH", "Wire"]

THROUGH = np.array([[-1.2, -2.0], [-2.5, -4.2], [0.0, -0.4], [-0.3, 0.3], [1.4, 1.0]])
"""A plan of `PathPlayer` that wires: far to one side, so that the cable lies straight, and back."""
_EDGE = 0.0283
_FIRST = (0.44, -0.13)
"""Where the first bead lies on average [m]."""
_POSTS = ((0.0636, -0.0141), (0.1591, -0.1414))
"""Of the posts from there [m]."""
_SHIFT = 0.01
"""Spread of the first bead along x and y [m]."""
_ASIDE = 0.007
"""Most that each post stands aside along x and y [m]: 1 cm of the source."""
_HIGH, _NEAR = 0.04, 0.02
"""Height to which beads cost nothing, and distance of the middle bead, in the source's metres."""


class Wire(HeldCable):
    """The cable between the posts."""

    name = "wire"
    instruction = "Lay the cable through between the two posts."
    success_score = 1.0
    ground_truth_size = 3 * 32
    objects = ("cable", "box", "box")
    held_particle = 3

    cable: ClassVar[CableConfig] = CableConfig(beads=30)
    within: ClassVar[int] = 4
    """Beads from the middle one to where the cable crosses the gap when it is solved, at most."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable | Box, ...]:
        """Add the cable and the posts, which have no mass, so nothing moves them."""
        cable = add_cable(builder, self.cable, cable_line(self.cable, _FIRST, (_FIRST[0], 1.0)))
        config = BoxConfig(parts=(BoxPart((_EDGE, _EDGE, _EDGE)),), color=GRAY)
        posts = [
            add_box(builder, config, (_FIRST[0] + x, _FIRST[1] + y, _EDGE / 2)) for x, y in _POSTS
        ]
        for post in posts:
            fix(builder, post)
        return (cable, *posts)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The cable straight, the posts beside it; targets (30, 3): beads in the gap."""
        x, y = rng.normal(_FIRST, _SHIFT)
        beads = cable_line(self.cable, (x, y), (x, y + 1.0))
        places = np.array([x, y]) + _POSTS + rng.uniform(-_ASIDE, _ASIDE, (2, 2))
        through = np.array([1.0, -1.0]) * (places[1] - places[0])[::-1]
        through *= np.sign(through[0]) / np.linalg.norm(through)
        along = self.cable.spacing * (self._middle - np.arange(self.cable.beads))
        targets = np.empty_like(beads)
        targets[:, :2] = places.mean(axis=0) + along[:, None] * through
        targets[:, 2] = beads[:, 2]
        posts = [[*place, _EDGE / 2, 0.0, 0.0, 0.0, 1.0] for place in places]
        return Layout(particle_q=beads, body_q=np.array(posts), targets=targets)

    @property
    def _middle(self) -> int:
        return self.cable.beads // 2

    @property
    def pays_on_the_way(self) -> bool:
        """False: the best return has a cable that lies near the gap soon, and never through it."""
        return False

    @property
    def solved_first(self) -> bool:
        """True: a cable that lies near the gap costs little, and is not laid."""
        return True

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """DLO-Lab's cost of every state (W,), without unit; lengths are in its metres."""
        places = np.stack([layout.targets for layout in layouts])
        rope, target = self.in_source(particle_q), self.in_source(particle_q.new_tensor(places))
        away = lengths(rope[:, :, None] - target[:, None])  # (W, P, P)
        high = (rope[..., 2] - _HIGH).clamp(min=0.0).mean(-1)
        middle = lengths(rope[:, self._middle, :2] - target[:, self._middle, :2])
        off = (middle - _NEAR).clamp(min=0.0)
        return away.amin(2).mean(-1) + away.amin(1).mean(-1) + high + 5.0 * off

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the cable lies between the posts."""
        beads, posts = snapshot.particle_q, layout.body_q[:, :2]
        centre, gap = posts.mean(axis=0), posts[1] - posts[0]
        width = float(np.linalg.norm(gap))
        axes = np.array([gap, [gap[1], -gap[0]]]) / width
        along, across = axes @ (beads[:, :2] - centre).T
        (crossings,) = np.nonzero(np.diff(across >= 0))
        if len(crossings) != 1 or float(beads[:, 2].max()) > _EDGE:
            return False
        bead = int(crossings[0])
        share = across[bead] / (across[bead] - across[bead + 1])
        at = along[bead] + share * (along[bead + 1] - along[bead])
        in_the_middle = abs(bead + share - self._middle) <= self.within
        return bool(in_the_middle and abs(at) < (width - _EDGE) / 2)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(96,): x, y, z of every bead, then of the posts."""
        points = np.concatenate([snapshot.particle_q, snapshot.body_q[:, :3]])
        return points.astype(np.float32).ravel()
