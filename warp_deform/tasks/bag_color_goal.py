"""bag-color-goal: put a block into the bag whose colour a goal image shows.

Source: Seita et al., ICRA 2021, appendix on bag-color-goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.bag import add_bag
from ..objects.box import Box, BoxConfig, BoxPart, add_box
from ..objects.colors import BLUE, CYAN, GREEN, PURPLE, RED, YELLOW, Color
from ..objects.scene_object import SceneObject
from ..support.quaternion import quat_from_yaw, quat_yaw
from .bag_opening import BAG_ROWS, BagTask
from .bag_physics import INSERT, OPEN
from .free_space import FreeSpace, first_that_fits
from .ground_truth import Row, pose_rows
from .task import Action, Layout, Snapshot, Stage

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["BagColorGoal"]

COLORS: tuple[Color, ...] = (PURPLE, BLUE, YELLOW, RED, GREEN, CYAN)
_ROOM = 0.025
"""Most room [m] beyond its size that the block is given where the opening is wide enough."""
_GOAL_SETTLE_SECONDS = 1.0


class BagColorGoal(BagTask):
    """The block has to lie in the opening of the bag that has the goal's colour; another bag waits.

    Layout.targets and a goal's targets (1 + 69, 3): first the target bag's x, y [m] where it was
    dropped and the number of its colour in `COLORS`; then the goal's rows of ground truth (two
    bags of 33, the block, two colours).

    Deliberate differences from the original: the bag's as in bag-alone-open; the block is set on
    the table instead of dropped; the goal is constructed by default, with the block in the opened
    target bag; the demonstrators put the block in as soon as it fits, and want no 10 cm of opening.
    """

    name = "bag-color-goal"
    instruction = "Put the block into the bag that has it in the goal picture."
    version = 5
    goal_conditioned = True
    stages = (OPEN, INSERT)
    success_score = 0.95
    ground_truth_rows = 2 * (*BAG_ROWS, *BAG_ROWS, (Row.POSE, 1), (Row.FIXED, 2))
    objects = ("bag", "block", "bag")

    block: ClassVar[BoxConfig] = BoxConfig(
        parts=(BoxPart((0.045, 0.045, 0.03)),), mass=0.1, friction=1.5
    )

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[SceneObject, ...]:
        """Add the target bag, the block and the other bag."""
        target = add_bag(builder, self.bag)
        block = add_box(builder, self.block, (0.5, 0.4, -self.block.lowest))
        aside = np.eye(4)
        aside[0, 3] = 0.5
        return target, block, add_bag(builder, self.bag, aside)

    # -- starting

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """Two bags of different colours about to fall, and a block of any of the colours."""
        target, other = rng.choice(len(COLORS), 2, replace=False)
        return first_that_fits(lambda: self._draw(rng, space, None, int(target), int(other)))

    def sample_for_goal(
        self, rng: np.random.Generator, space: FreeSpace, targets: np.ndarray
    ) -> Layout:
        """The target bag where the goal has it, in its colour; the rest is drawn."""
        x, y, color = targets[0]
        others = [n for n in range(len(COLORS)) if n != int(color)]
        other = others[rng.integers(len(others))]
        place = float(x), float(y)
        layout = first_that_fits(lambda: self._draw(rng, space, place, int(color), other))
        return layout.with_targets(targets)

    def _draw(
        self,
        rng: np.random.Generator,
        space: FreeSpace,
        place: tuple[float, float] | None,
        color: int,
        other: int,
    ) -> Layout:
        radius = self.bag.radius
        x, y = place or space.sample(rng, radius, radius, extent=radius)[:2]
        space = space.occupy_disc((x, y), radius)
        width, depth, height = self.block.parts[0].size
        bx, by, yaw = space.sample(rng, width, depth)
        space = space.occupy_disc((bx, by), float(np.hypot(width, depth)) / 2)
        # both bags spread when they fall
        ox, oy, _ = space.occupy_disc((x, y), 2 * radius).sample(rng, radius, radius, extent=radius)
        first = self.drop(rng, x, y)
        block_color = COLORS[rng.integers(len(COLORS))]
        return Layout(
            particle_q=np.concatenate([first, self.drop(rng, ox, oy)]),
            body_q=np.array([[bx, by, height / 2, *quat_from_yaw(yaw)]]),
            targets=np.concatenate([[[x, y, color]], np.zeros((69, 3))]),
            pushes=(self.push(rng, 0), self.push(rng, len(first))),
            settle_seconds=self.settle_seconds,
            configs={
                0: replace(self.bag, color=COLORS[color]),
                1: replace(self.block, color=block_color),
                2: replace(self.bag, color=COLORS[other]),
            },
        )

    def goal_layout(self, layout: Layout) -> Layout:
        """The target bag open with the block in it; the other bag as it was dropped."""
        x, y, _ = layout.targets[0]
        upright = self.upright(float(x), float(y))
        particles = layout.particle_q.copy()
        particles[: len(upright)] = upright
        inside = np.array([[x, y, 0.03 - self.block.lowest, 0.0, 0.0, 0.0, 1.0]])
        return replace(
            layout,
            particle_q=particles,
            body_q=inside,
            pushes=layout.pushes[1:],
            settle_seconds=_GOAL_SETTLE_SECONDS,
        )

    def goal_shows_its_start(self) -> bool:
        """True: the block in its colour, and the other bag."""
        return True

    def goal_targets(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(70, 3): where the target bag was dropped, its colour's number, and the rows of truth."""
        return np.concatenate([layout.targets[:1], self._rows(layout, snapshot)])

    def ring_targets_of(self, layout: Layout) -> np.ndarray:
        """Where the beads of the open target bag should lie (32, 2) [m]."""
        return self.ring_targets(*layout.targets[0, :2])

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """The block can be seen, and is not in the target bag yet."""
        seen = bool(self.item_mask(layout, snapshot, 0).any())
        return seen and not self.solved(layout, snapshot)

    # -- scoring

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Share of the block's visible pixels within the hull of the target bag's visible beads."""
        if self.hidden(layout, snapshot):
            return 0.0
        block = self.item_mask(layout, snapshot, 0)
        inside = block & self.hull_mask(layout, snapshot).astype(bool)
        return float(np.count_nonzero(inside) / (np.count_nonzero(block) + 0.01))

    # -- demonstrators

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Open the target bag until the block fits, then put it in, again if it has to be.

        The original waits for 10 cm of opening. To wait for them for some actions only would be a
        rule that no policy can learn from pictures, which do not show how many actions have passed.
        """
        if self.hidden(layout, snapshot):
            return None
        tried = any(self.stage_of(float(a[6])) is INSERT for a in snapshot.actions)
        clear = self._widest(layout, snapshot)
        if clear.any():
            return self.insert(layout, snapshot, rng, clear)
        return None if tried else self.pull_farthest(layout, snapshot)

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The same with picks that the tip really meets; opens again where it has to."""
        clear = self._widest(layout, snapshot)
        action = self.insert(layout, snapshot, rng, clear) if clear.any() else None
        return action if action is not None else self.pull_visible(layout, snapshot)

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Pulls, and the widest places for the block where it fits the opening at all."""
        clear = self._widest(layout, snapshot)
        actions: list[Action] = []
        if clear.any():
            draws = (self.insert(layout, snapshot, rng, clear) for _ in range(count // 2))
            actions = [action for action in draws if action is not None]
        return actions + self.pulls(layout, snapshot, rng, count - len(actions))

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """The score, then how far the target bag is open."""
        opened = self.opening(snapshot) - 0.5 * self.map_distance(layout, snapshot)
        return 2.0 * self.score(layout, snapshot) + opened

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Distance [m] of the block from the target bag's opening, and how far that is not open."""
        centre = self.ring_of(snapshots, particle_q)[..., :2].mean(1)
        away = ((body_q[:, 0, :2] - centre).square().sum(-1) + 1e-8).sqrt()
        return self.opening_loss(layouts, snapshots, particle_q) + away

    def privileged_stage(self, segment: int, snapshot: Snapshot, previous: Stage | None) -> Stage:
        """A pick on the block is to insert it, any other to open the bag."""
        number = next(i for i, item in enumerate(snapshot.objects) if isinstance(item, Box))
        return INSERT if segment in snapshot.segments[number] else OPEN

    def _widest(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Where (320, 160) the block fits with the most room, at most `_ROOM`; empty if nowhere.

        Even there the opening's hull is as wide as the block's diagonal.
        """
        size = self.block.parts[0].size[:2]
        for room in np.linspace(_ROOM, 0.0, 9):
            clear = self.clear_opening(layout, snapshot, size, float(room))
            if clear.any():
                break
        return clear

    # -- ground truth

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(414,): both bags, the block and the bags' colours in [0, 1], then those of the goal."""
        return np.concatenate(
            [self._rows(layout, snapshot), layout.targets[1:].astype(np.float32)]
        ).ravel()

    def _rows(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(69, 3): 33 poses of each bag, the block's, two colours."""
        block = snapshot.body_q[0]
        colors = [self.bag_of(snapshot, n).config.color for n in range(2)]
        return np.concatenate(
            [
                self.bag_rows(layout, snapshot, 0),
                self.bag_rows(layout, snapshot, 1),
                pose_rows(block[:2], quat_yaw(block[3:])),
                np.array(colors, np.float32) / 255,
            ]
        )
