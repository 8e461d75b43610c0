"""cable-mask-goal: bring a bead chain with a parallel jaw to where a goal mask shows it.

This is the paper's physical task, in simulation, where all that is seen is masks. A chain of 45 cm
lies lightly tossed on 60 x 30 cm of foam. An episode succeeds as soon as the intersection over
union of its mask with the goal's exceeds 0.25, within 10 actions. Not one of the benchmark's 13
tasks.

Masks and physics differ between episodes, so that what is learned here holds on a robot: width,
scale, tilt, shift, gaps and outline of the mask; friction of foam and chain, and stiffness.
The score compares true masks.

Source: Seita et al., ICRA 2021, section on physical experiments. The paper's demonstrations and
goals were made by hand; here goals are smooth curves, and the scripted demonstrator is that of the
simulated cable tasks, but takes one of a few beads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.cable import Cable, CableConfig, add_cable
from ..rendering.drawables import WORKSPACE_SEGMENT, Drawables
from ..rendering.images import Images
from ..rendering.pixels import SHAPE, PixelGrid
from ..rendering.strand_mask import MaskLook, strand_mask
from ..robots.jaw_primitive import JawActionConfig, hand_pose
from .chain_physics import BEAD_CHAIN, CHAIN_SOLVER
from .chain_shapes import curved_chain, straight_chain, tossed_chain
from .free_space import FreeSpace
from .ground_truth import Row, pose_rows
from .metrics import mask_iou
from .strand_grasp import find_strand_grasp, map_direction, wrap_half_turn
from .target_shapes import chain_yaw
from .task import Action, Layout, Snapshot, Stage, Task

if TYPE_CHECKING:
    import newton

    from ..rendering.topdown import TopDown

__all__ = ["CableMaskGoal"]

_SETTLE_SECONDS = 0.5
_APART = 0.03
"""Distance between the picks of two candidates [m]."""
_ENDS = 2
"""So many beads from an end it is taken at least: half of a pad then holds beads."""


class CableMaskGoal(Task):
    """A bead chain, a parallel jaw, masks."""

    name = "cable-mask-goal"
    instruction = "Bring the chain to where the goal mask shows it."
    goal_conditioned = True
    version = 2
    max_actions = 10
    stages = (Stage(lift=0.05, speed=0.10),)
    solver = CHAIN_SOLVER
    jaw = JawActionConfig()
    rotated_copies = 24
    success_score = 0.25
    ground_truth_rows = ((Row.BEAD, 2 * BEAD_CHAIN.beads),)
    objects = ("bead chain",)

    cable: ClassVar[CableConfig] = BEAD_CHAIN
    x: ClassVar[tuple[float, float]] = (0.335, 0.635)
    """Workspace along x [m], from the base of a Panda: 30 cm that it reaches hand-down."""
    y: ClassVar[tuple[float, float]] = (-0.30, 0.30)
    """Workspace along y [m]: 60 cm."""
    grid = PixelGrid((0.335 + 0.001875 / 2, -0.30 + 0.001875 / 2), 0.001875)
    goal_bend: ClassVar[tuple[float, float]] = (0.0, 1.2)
    """Least and greatest bend of a goal, see `curved_chain`."""
    randomised: ClassVar[bool] = True
    """Whether masks and physics differ between episodes."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable]:
        """Add the chain, straight along the middle."""
        middle = np.mean([self.x, self.y], axis=1)
        return (add_cable(builder, self.cable, straight_chain(self.cable, middle, np.pi / 2)),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A smooth goal, a tossed chain, and this episode's physics and look."""
        bend = rng.uniform(*self.goal_bend)
        goal = curved_chain(rng, self.cable, self.x, self.y, bend=bend)
        start = tossed_chain(rng, self.cable, self.x, self.y)
        physics = {
            "table_friction": float(self.solver.table_friction * rng.uniform(0.7, 1.4)),
            "contact_friction": float(self.solver.contact_friction * rng.uniform(0.5, 1.5)),
            "stiffness": float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))),
        }
        look = MaskLook.draw(rng)
        return Layout(
            particle_q=start,
            body_q=np.zeros((0, 7)),
            targets=goal[:, :2],
            settle_seconds=_SETTLE_SECONDS,
            physics=physics if self.randomised else {},
            look=look if self.randomised else None,
        )

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Unsolved, and the whole chain in view."""
        (x0, x1), (y0, y1), q = self.x, self.y, snapshot.particle_q
        inside = (q[:, 0] > x0) & (q[:, 0] < x1) & (q[:, 1] > y0) & (q[:, 1] < y1)
        return bool(inside.all()) and not self.solved(layout, snapshot)

    def mask(self, points: np.ndarray, *, look: MaskLook | None = None) -> np.ndarray:
        """Mask (320, 160) bool of a chain whose beads lie at `points` (90, 2 or more) [m]."""
        return strand_mask(points[:, :2], 2 * self.cable.visual_radius, self.grid, look=look)

    def draw(
        self,
        topdown: TopDown,
        layout: Layout,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
    ) -> Images:
        """The mask as the colour's three channels, 0 or 255; no height."""
        mask = self.mask(particle_q, look=layout.look)
        chain = drawables.segments[-1][0]
        return Images(
            color=np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2),
            height=np.zeros(SHAPE, np.float32),
            segmentation=np.where(mask, chain, WORKSPACE_SEGMENT).astype(np.uint8),
        )

    def pick_yaw(self, color: np.ndarray, xy: np.ndarray) -> float:
        """The chain's tangent [rad] in the mask near `xy`; 0 where there is no chain."""
        row, column = self.grid.to_pixel(xy)
        grasp = find_strand_grasp(color[..., 0] > 127, (int(row), int(column)))
        return 0.0 if grasp is None else map_direction(grasp.tangent, np.eye(2))

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Intersection over union of the chain's true mask and the goal's."""
        return mask_iou(self.mask(snapshot.particle_q), self.mask(layout.targets))

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the overlap exceeds 0.25."""
        return self.score(layout, snapshot) > self.success_score

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Take of `grips` beads the farthest from its target, across the chain, and bring it there.

        Beads that the open fingers cannot come down on without touching other parts of the chain
        are left for later, unless all of these are such.
        """
        return next(self.demonstrated_moves(layout, snapshot))

    @property
    def grips(self) -> int:
        """Beads that the demonstrator takes, spread evenly over the chain."""
        return 5

    def demonstrated_moves(self, layout: Layout, snapshot: Snapshot) -> Iterator[Action]:
        """What `demonstrate` would do, and what in its place where that cannot be done."""
        spread = np.linspace(_ENDS, self.cable.beads - 1 - _ENDS, self.grips)
        return self._moves(layout, snapshot, np.round(spread).astype(int))

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Moves of any beads, well apart from each other, the farthest from its target first."""
        chosen: list[Action] = []
        for move in self._moves(layout, snapshot, np.arange(self.cable.beads)):
            gaps = [np.linalg.norm(move[:2] - other[:2]) for other in chosen]
            if all(gap > _APART for gap in gaps):
                chosen.append(move)
            if len(chosen) == count:
                break
        return chosen

    def _moves(self, layout: Layout, snapshot: Snapshot, beads: np.ndarray) -> Iterator[Action]:
        """Moves of graspable beads, then of the others; of either the farthest from its target.

        Args:
            beads: which may be taken (n,) int
        """
        q = snapshot.particle_q[:, :2].astype(float)
        ways = (layout.targets, layout.targets[::-1])
        distances = [np.linalg.norm(q - way, axis=1) for way in ways]
        better = int(np.argmin([d.mean() for d in distances]))
        order = beads[np.argsort(-distances[better][beads], kind="stable")]
        moves = [self.action(q, ways[better], int(bead)) for bead in order]
        free = [self.graspable(snapshot.particle_q, move) for move in moves]
        for wanted in (True, False):
            yield from (
                move for move, is_free in zip(moves, free, strict=True) if is_free is wanted
            )

    def action(self, q: np.ndarray, targets: np.ndarray, bead: int) -> Action:
        """Action (7,) that takes `bead`, or one near the end, of a chain `q` to its target.

        The hand does not turn on the way, as with the benchmark's cables.

        Args:
            q: centres of the beads (90, 2) [m]
            targets: where they are to lie (90, 2) [m]
        """
        bead = min(max(bead, _ENDS), self.cable.beads - 1 - _ENDS)
        yaw = wrap_half_turn(_tangent(q, bead))
        return np.array([*q[bead], yaw, *targets[bead], yaw, self.stages[0].lift])

    def graspable(self, particle_q: np.ndarray, action: Action) -> bool:
        """Whether the open fingers of an action come down on foam, about a single strand.

        Args:
            particle_q: (90, 3) [m]
        """
        jaw, r = self.jaw, self.cable.radius
        tip = np.array([*action[:2], jaw.grasp_m, action[2]])
        pose = hand_pose(tip)
        local = (particle_q - pose[:3, 3]) @ pose[:3, :3]
        x, y = np.abs(local[:, 0]), np.abs(local[:, 1])
        inner, outer = jaw.open_width_m / 2, jaw.open_width_m / 2 + jaw.fingers.thickness
        long = x < jaw.fingers.pad_length / 2 + r
        if (long & (y > inner - r) & (y < outer + r)).any():
            return False
        inside = np.flatnonzero(long & (y <= inner - r))
        return len(inside) > 0 and bool((np.diff(inside) == 1).all())

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """Score, less the beads' mean distance from their targets the better way round."""
        q = snapshot.particle_q[:, :2]
        ways = np.stack([layout.targets, layout.targets[::-1]])
        distances = np.linalg.norm(q - ways, axis=2).mean(axis=1)
        return self.score(layout, snapshot) - float(distances.min()) / self.cable.length

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(540,): x, y, -yaw / 15 of every bead, then the same of the goal's beads."""
        both = (snapshot.particle_q, layout.targets)
        rows = [pose_rows(points, chain_yaw(points, closed=False)) for points in both]
        return np.concatenate(rows).ravel()

    def goal_layout(self, layout: Layout) -> Layout:
        """The chain laid on the targets."""
        height = np.full(self.cable.beads, self.cable.radius)
        beads = np.column_stack([layout.targets, height])
        return replace(layout, particle_q=beads, calm=True)

    def goal_targets(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Where the beads lie (90, 2) [m]."""
        return np.array(snapshot.particle_q[:, :2], dtype=float)


def _tangent(points: np.ndarray, i: int) -> float:
    """Angle [rad] of a chain's tangent at bead i, over the length of a pad."""
    x, y = points[min(i + 2, len(points) - 1)] - points[max(i - 2, 0)]
    return float(np.arctan2(y, x))
