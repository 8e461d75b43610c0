"""fabric-cover: put a cube onto a fabric and fold the fabric over it.

Source: Seita et al., ICRA 2021, appendix on fabric-cover.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.box import Box, BoxConfig, add_box
from ..objects.cloth import Cloth, ClothConfig, add_cloth, cloth_sheet
from ..rendering.pixels import PIXEL_SIZE
from ..support.quaternion import quat_from_yaw, quat_yaw
from .cloth_physics import FABRIC, FABRIC_PRIMITIVE, FABRIC_SOLVER, FABRIC_SPEED
from .demonstrators import pick_place
from .fabric_pull import beyond, corners, first_taken, on_table
from .free_space import FreeSpace
from .ground_truth import Row, pose_rows
from .losses import cover_distance
from .metrics import wrap_angle
from .target_shapes import to_world
from .task import Action, Layout, Snapshot, Stage, Task

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["FabricCover"]

_DROP = 0.01  # [m] height from which the fabric falls
_YAW_SPREAD = 0.5  # [rad] standard deviation of the fabric's yaw
_SETTLE_SECONDS = 0.3


class FabricCover(Task):
    """A cube has to be hidden under a fabric, in two actions.

    Deliberate differences from the original: the cube's inertia is that of a solid cube, and it is
    set on the table instead of dropped.
    """

    name = "fabric-cover"
    instruction = "Cover the cube with the fabric."
    version = 4
    max_actions = 2
    stages = (Stage(lift=0.10, speed=FABRIC_SPEED),)
    solver = FABRIC_SOLVER
    primitive = FABRIC_PRIMITIVE
    success_score = 1.0
    ground_truth_rows = ((Row.POSE, 1), (Row.POINT, 100))
    objects = ("cube", "fabric")

    fabric: ClassVar[ClothConfig] = FABRIC
    cube: ClassVar[BoxConfig] = BoxConfig()
    farthest: ClassVar[float] = 0.25
    """A hidden cube is covered when it is this near to the fabric's centre [m]."""
    overshoot: ClassVar[float] = 0.03
    """How far beyond the opposite corner the demonstrator pulls a corner [m]."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Box, Cloth]:
        """Add the cube and the fabric beside it."""
        return (
            add_box(builder, self.cube, (0.5, 0.3, -self.cube.lowest)),
            add_cloth(builder, self.fabric, cloth_sheet(self.fabric, (0.5, 0.0))),
        )

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The cube anywhere, and the flat fabric about to fall, clear of it."""
        size = self.cube.parts[0].size[0]
        x, y, yaw = space.sample(rng, size, size)
        square = to_world(
            size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), np.array([x, y, yaw])
        )
        side = self.fabric.side
        u, v, _ = space.occupy_polygon(square).sample(
            rng, side, side, extent=side / np.sqrt(2) + self.overshoot
        )
        turn = rng.normal(0.0, _YAW_SPREAD)
        turned = wrap_angle(yaw)
        pose = [x, y, -self.cube.lowest, *quat_from_yaw(turned)]
        return Layout(
            particle_q=cloth_sheet(self.fabric, (u, v), yaw=turn, height=_DROP),
            body_q=np.array([pose]),
            targets=np.zeros((0, 2)),
            settle_seconds=_SETTLE_SECONDS,
        )

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """1 when no pixel from above shows the cube and it is near the fabric's centre, else 0."""
        hidden = not (snapshot.images.segmentation == snapshot.segments[0][0]).any()
        return float(hidden and self._distance(snapshot) <= self.farthest)

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Put the cube on the fabric's centre, then fold a random corner over to the opposite."""
        if len(snapshot.actions) == 0:
            return self._put(snapshot)
        folds = self._folds(snapshot, rng, self.overshoot)
        return next(iter(folds.values()), None)

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The same, with a random corner of those that the tip really takes, if there are any."""
        if len(snapshot.actions) == 0:
            return self._put(snapshot)
        folds = self._folds(snapshot, rng, self.overshoot)
        return first_taken(folds, self.fabric, snapshot, self.primitive)

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """The visible demonstrator's action, then others like it that place elsewhere."""
        first = self.demonstrate_visible(layout, snapshot, rng)
        if first is None:
            return []
        drawn = [first]
        while len(drawn) < count:
            if len(snapshot.actions) == 0:
                other = self._put(snapshot)
                other[3:5] += rng.normal(0.0, self.cube.parts[0].size[0] / 2, 2)
                drawn.append(other)
            else:
                far = rng.normal(self.overshoot, self.overshoot)
                drawn += self._folds(snapshot, rng, far).values()
        return [action for action in drawn[:count] if on_table(action[3:5])]

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """Share of the cube's face that is hidden, less its distance from the fabric's centre."""
        return self._hidden(snapshot) - self._distance(snapshot)

    def measures(self, layout: Layout, snapshot: Snapshot) -> dict[str, float]:
        """Coverage: share of the cube's face that is hidden."""
        return {"coverage": self._hidden(snapshot)}

    def _hidden(self, snapshot: Snapshot) -> float:
        """Share of the cube's face that no pixel from above shows."""
        seen = np.count_nonzero(snapshot.images.segmentation == snapshot.segments[0][0])
        face = np.prod(self.cube.parts[0].size[:2]) / PIXEL_SIZE**2
        return float(1.0 - min(1.0, seen / face))

    def loss(
        self, layout: Layout, snapshot: Snapshot, particle_q: Tensor, body_q: Tensor
    ) -> Tensor:
        """Soft distance [m] of the fabric from points of the cube's face, and of the centres."""
        half = self.cube.parts[0].size[0] / 2
        spots = half * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
        points = body_q[0, :2] + body_q.new_tensor(spots)
        upper = particle_q[particle_q[:, 2] > body_q[0, 2]]
        centre = particle_q[list(self.fabric.inner_corners), :2].mean(0)
        apart = ((body_q[0, :2] - centre).square().sum() + 1e-8).sqrt()
        cell = self.fabric.side / self.fabric.columns
        hidden = cover_distance(upper, points, cell / 4) if len(upper) else apart
        return hidden + apart

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(303,): x, y, -yaw / 15 of the cube, then x, y, z of every vertex."""
        cube = snapshot.body_q[0]
        rows = pose_rows(cube, quat_yaw(cube[3:]))
        return np.concatenate([rows.ravel(), snapshot.particle_q.ravel()]).astype(np.float32)

    def _distance(self, snapshot: Snapshot) -> float:
        """From the cube's centre to the fabric's, which is the middle of its corners [m]."""
        centre = corners(self.fabric, snapshot).mean(axis=0)
        return float(np.linalg.norm(snapshot.body_q[0, :3] - centre))

    def _put(self, snapshot: Snapshot) -> Action:
        """The cube to the fabric's centre."""
        centre = corners(self.fabric, snapshot).mean(axis=0)
        return pick_place(snapshot.body_q[0, :2], centre, stage=self.stages[0])

    def _folds(
        self, snapshot: Snapshot, rng: np.random.Generator, overshoot: float
    ) -> dict[int, Action]:
        """Every corner on the table over to the opposite one, by its vertex, in random order."""
        points = corners(self.fabric, snapshot)
        return {
            self.fabric.inner_corners[i]: pick_place(
                points[i], beyond(points[i], points[(i + 2) % 4], overshoot), stage=self.stages[0]
            )
            for i in rng.permutation(4)
            if on_table(points[i])
        }
