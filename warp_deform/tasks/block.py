"""block-notarget: put an L-shaped block where a goal image shows it.

Source: Seita et al., ICRA 2021, appendix on block-notarget.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box, BoxConfig, add_box, l_block
from ..support.quaternion import quat_from_yaw, quat_yaw
from ..xpbd.config import SolverConfig
from .demonstrators import pick_place_pose, visible_point
from .free_space import FreeSpace
from .ground_truth import Row, pose_rows
from .metrics import pose_error, wrap_angle
from .target_shapes import to_world
from .task import Action, Layout, Snapshot, Stage, Task

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["BlockNotarget"]

_ROOM = 0.1  # [m] side of the square that the block is given
_SETTLE_SECONDS = 0.5


class BlockNotarget(Task):
    """The block has to lie within 1 cm and 15 degrees of a pose that only the goal image shows.

    Deliberate differences from the original: the block's inertia is that of its two boxes; it is
    set on the table instead of dropped.
    """

    name = "block-notarget"
    instruction = "Move the block to where the goal picture shows it."
    goal_conditioned = True
    version = 2
    max_actions = 2
    stages = (Stage(lift=0.30, speed=0.5),)
    place_yaws = 24
    success_score = 1.0
    ground_truth_rows = ((Row.POSE, 2),)
    objects = ("block",)
    # friction multiplies: 0.3 of the block times 1.0 of the table, as in the original
    solver = SolverConfig(table_friction=1.0, contact_friction=1.0)

    block: ClassVar[BoxConfig] = l_block()
    position_tolerance: ClassVar[float] = 0.01  # [m]
    yaw_tolerance: ClassVar[float] = math.radians(15)

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Box]:
        """Add the block in the middle of the table."""
        return (add_box(builder, self.block, (0.5, 0.0, -self.block.lowest)),)

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A free pose for the block and another one, clear of the block, for the target."""
        pose = self._sample_pose(rng, space)
        for part in self.block.parts:
            half = np.array(part.size[:2]) / 2
            square = half * [[-1, -1], [1, -1], [1, 1], [-1, 1]] + part.offset[:2]
            space = space.occupy_polygon(to_world(square, pose))
        return Layout(
            particle_q=np.zeros((0, 3)),
            body_q=self._body(pose),
            targets=self._sample_pose(rng, space),
            settle_seconds=_SETTLE_SECONDS,
        )

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """1 when the block is at the target's pose, else 0."""
        distance, turn = pose_error(self._pose(snapshot), layout.targets)
        return float(distance < self.position_tolerance and turn < self.yaw_tolerance)

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Pick anywhere on the block's eroded mask and move it rigidly to the target."""
        pick = visible_point(snapshot.images.segmentation == snapshot.segments[0][0], rng)
        if pick is None:
            return None
        return pick_place_pose(pick, self._pose(snapshot), layout.targets, stage=self.stages[0])

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """The score, less the distance from the target [m] and the turn from it [rad] by 100."""
        distance, turn = pose_error(self._pose(snapshot), layout.targets)
        return self.score(layout, snapshot) - distance - turn / 100

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Distances from the targets [m], and 5 cm for each radian of turn from them."""
        goals = np.stack([layout.targets for layout in layouts])
        yaw = goals[:, 2]
        away = (body_q[:, 0, :2] - body_q.new_tensor(goals[:, :2])).square().sum(-1)
        qx, qy, qz, qw = body_q[:, 0, 3:].unbind(-1)
        across, along = 2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz
        length = (across.square() + along.square()).sqrt()
        cos, sin = (body_q.new_tensor(part) for part in (np.cos(yaw), np.sin(yaw)))
        turn = (along / length - cos).square() + (across / length - sin).square()
        return (away + 1e-8).sqrt() + 0.05 * (turn + 1e-8).sqrt()

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(6,): x, y, -yaw / 15 of the block, then of the goal."""
        poses = np.stack([self._pose(snapshot), layout.targets])
        return pose_rows(poses, poses[:, 2]).ravel()

    def goal_layout(self, layout: Layout) -> Layout:
        """The block standing at the target."""
        return replace(layout, body_q=self._body(layout.targets), calm=True)

    def goal_targets(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """The block's pose (3,) x, y [m], yaw [rad]."""
        return self._pose(snapshot)

    def _sample_pose(self, rng: np.random.Generator, space: FreeSpace) -> np.ndarray:
        x, y, yaw = space.sample(rng, _ROOM, _ROOM)
        return np.array([x, y, wrap_angle(yaw)])

    def _body(self, pose: np.ndarray) -> np.ndarray:
        """Pose (1, 7) of the upright block on the table at `pose` (3,)."""
        x, y, yaw = pose
        return np.array([[x, y, -self.block.lowest, *quat_from_yaw(yaw)]])

    def _pose(self, snapshot: Snapshot) -> np.ndarray:
        x, y, *_ = snapshot.body_q[0]
        return np.array([x, y, quat_yaw(snapshot.body_q[0, 3:7])], dtype=float)
