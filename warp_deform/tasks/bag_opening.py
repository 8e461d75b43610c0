"""What the bag tasks share: how a bag is laid out, what its opening shows, and how it is opened.

Source: Seita et al., ICRA 2021, appendix on bag tasks.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import cv2
import numpy as np

from ..objects.bag import Bag, BagConfig, BagShell, bag_shell
from ..objects.box import Box
from ..objects.push import Push
from ..objects.surface import area_share
from ..rendering.pixels import PIXEL_SIZE, SHAPE, TABLE_GRID, pixel_to_world
from ..robots.primitive import PrimitiveConfig, find_grasp
from .bag_physics import BAG_PRIMITIVE, BAG_SOLVER, INSERT, OPEN
from .demonstrators import farthest_bead, pick_place, ring_maps, visible_point
from .ground_truth import Row, Rows, pose_rows
from .history import PastAction
from .losses import mean_distance, ring_area
from .metrics import hull_area
from .target_shapes import chain_yaw
from .task import Action, Layout, Snapshot, Task

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["BAG_ROWS", "BagTask", "bag_mask", "enclosed"]

BAG_ROWS: Rows = ((Row.BEAD, 32), (Row.DISPLACEMENT, 1))
"""A bag's part of a ground truth: the beads of its opening, and how far it has moved."""

DROP = 0.15
"""Height of the sphere's centre from which a bag falls [m]."""
_TILT = 0.25  # [rad] standard deviation about each axis
_PUSH_SECONDS = 0.2
_SETTLE_SECONDS = 1.0
OVERSHOOT = 0.02
"""How far beyond its target a bead is pulled [m]."""
_WORTH = 0.5
"""A bead so much farther from its target [m] is worth pulling as if it opened the whole circle."""
FEWEST_VISIBLE = 0.33
"""The demonstrators give up where no more than this share of the beads can be seen."""
_RAYS = 96
_OFF_TABLE = 0.01  # [m] that an item's lowest point is above the table when it has left it
_INSIDE = 0.75  # share of the rays sideways and down that meet the shell around an item inside


class BagTask(Task):
    """A task with bags of one kind; the first bag is the one that is to be opened."""

    version = 2
    solver = BAG_SOLVER
    primitive: ClassVar[PrimitiveConfig] = BAG_PRIMITIVE
    max_actions = 8
    least_loss = -1.0  # of a bag that is open all round
    bag: ClassVar[BagConfig] = BagConfig()
    pushes: ClassVar[int] = 8
    """Number of the original's pushes of up to 10 N sideways and 8 N up at 480 Hz."""

    # -- laying out

    def drop(self, rng: np.random.Generator, x: float, y: float) -> np.ndarray:
        """Positions (P, 3) of a bag that is about to fall, its opening up, a little tilted."""
        from scipy.spatial.transform import Rotation  # slow to import

        turn = Rotation.from_euler("xyz", rng.normal(0.0, _TILT, 3))
        return turn.apply(_shell(self.bag).vertices) + np.array([x, y, DROP])

    def upright(self, x: float, y: float) -> np.ndarray:
        """Positions (P, 3) of an open bag that stands on the table."""
        height = self.bag.radius + self.bag.shell_radius
        return _shell(self.bag).vertices + np.array([x, y, height])

    def push(self, rng: np.random.Generator, first: int) -> Push:
        """The perturbation of one bead of the bag whose particles begin at `first`.

        Its impulse is that of the original's pushes, spread over 0.2 s.
        """
        shell = _shell(self.bag)
        bead = int(shell.ring[rng.integers(len(shell.ring))])
        force = np.array([rng.integers(-10, 11), rng.integers(-10, 11), 8], dtype=float)
        impulse = force * self.pushes / 480
        return Push(first + bead, impulse / _bead_mass(self.bag) / _PUSH_SECONDS, _PUSH_SECONDS)

    def ring_targets(self, x: float, y: float) -> np.ndarray:
        """Where the beads of an open bag at x, y would lie (32, 2) [m]."""
        shell = _shell(self.bag)
        return shell.vertices[shell.ring, :2] + [x, y]

    def ring_targets_of(self, layout: Layout) -> np.ndarray:
        """Where the beads of the open bag should lie (32, 2) [m]."""
        return layout.targets

    @property
    def settle_seconds(self) -> float:
        """Time that a bag gets at least after its push [s]."""
        return _SETTLE_SECONDS

    # -- looking

    def bag_of(self, snapshot: Snapshot, number: int = 0) -> Bag:
        """The bag with this number among the scene's bags."""
        return [item for item in snapshot.objects if isinstance(item, Bag)][number]

    def beads(self, snapshot: Snapshot, number: int = 0) -> np.ndarray:
        """Positions (32, 3) of a bag's beads, around the opening."""
        return snapshot.particle_q[list(self.bag_of(snapshot, number).ring)].astype(float)

    def opening(self, snapshot: Snapshot) -> float:
        """Area of the hull of the beads over that of the opening at rest."""
        area = hull_area(self.beads(snapshot)[:, :2])
        return area / (math.pi * self.bag.opening_radius**2)

    def visible_beads(self, layout: Layout, snapshot: Snapshot, number: int = 0) -> np.ndarray:
        """Which beads (V,) of a bag have a pixel in the segmentation."""
        ids = self._segments(layout, snapshot, self.bag_of(snapshot, number))
        seen = np.isin(np.arange(ids.start + 1, ids.stop), snapshot.images.segmentation)
        return np.flatnonzero(seen)

    def hidden(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether too few beads of the first bag are visible to go on."""
        beads = len(self.bag_of(snapshot).ring)
        return len(self.visible_beads(layout, snapshot)) <= FEWEST_VISIBLE * beads

    def hull_mask(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Filled convex hull (320, 160) uint8 of all pixels of the first bag's visible beads."""
        ids = self._segments(layout, snapshot, self.bag_of(snapshot))
        return bag_mask(snapshot.images.segmentation, ids.start + 1, ids.stop)

    def clear_opening(
        self, layout: Layout, snapshot: Snapshot, size: tuple[float, float], room: float
    ) -> np.ndarray:
        """Where (320, 160) uint8 a thing of `size` [m] fits with `room` [m] to spare."""
        return self.erode(self.hull_mask(layout, snapshot), size, room)

    @staticmethod
    def erode(mask: np.ndarray, size: tuple[float, ...], room: float) -> np.ndarray:
        """`mask` less a rim as wide as half the diagonal of `size` (2,) [m] plus `room` [m]."""
        width = round(math.hypot(size[0] + room, size[1] + room) / PIXEL_SIZE)
        return cv2.erode(mask, np.ones((width, width), np.uint8))

    def inside_bag(self, snapshot: Snapshot, body: int) -> bool:
        """Whether a body's centre is inside the first bag."""
        bag = self.bag_of(snapshot)
        return _inside(bag, snapshot.particle_q, snapshot.body_q[body])

    def enclosed(self, layout: Layout, snapshot: Snapshot) -> bool | None:
        """Whether every item is inside the first bag; None without items."""
        bodies = range(len(snapshot.body_q))
        return all(self.inside_bag(snapshot, b) for b in bodies) if len(bodies) else None

    def was_aloft(self, snapshot: Snapshot, past: PastAction) -> bool:
        """Whether every item hung inside the first bag while that hung highest in an action."""
        if past.aloft is None:
            return False
        bag, body_q = self.bag_of(snapshot), past.aloft.body_q
        boxes = [item for item in snapshot.objects if isinstance(item, Box)]
        off = all(body_q[box.body, 2] + box.config.lowest > _OFF_TABLE for box in boxes)
        return off and all(_inside(bag, past.aloft.particle_q, pose) for pose in body_q)

    def met_beads(self, snapshot: Snapshot, number: int = 0) -> list[int]:
        """Beads of a bag that a tip descending at their centre really takes."""
        ring = self.bag_of(snapshot, number).ring
        met = []
        for bead, particle in enumerate(ring):
            grasp = find_grasp(
                np.append(snapshot.particle_q[particle, :2], 0.0),
                snapshot.objects,
                snapshot.particle_q,
                snapshot.body_q,
                self.primitive,
            )
            if grasp is not None and grasp.particle == particle:
                met.append(bead)
        return met

    def _segments(self, layout: Layout, snapshot: Snapshot, item: object) -> range:
        """Segmentation ids of an object: of a bag, first the shell's, then those of its beads."""
        return snapshot.segments[len(layout.zones) + snapshot.objects.index(item)]

    # -- gradients

    def ring_of(self, snapshots: Sequence[Snapshot], particle_q: Tensor) -> Tensor:
        """Beads (W, 32, 3) around the opening of the first bag, of particles (W, P, 3)."""
        return particle_q[:, list(self.bag_of(snapshots[0]).ring)]

    def opening_loss(
        self, layouts: Sequence[Layout], snapshots: Sequence[Snapshot], particle_q: Tensor
    ) -> Tensor:
        """How far the first bag's beads are from their targets, less how far it is open (W,)."""
        radius = self.bag.opening_radius
        beads = self.ring_of(snapshots, particle_q)
        maps = ring_maps(beads.shape[1], reversals=False)
        targets = np.stack([self.ring_targets_of(layout) for layout in layouts])
        away = mean_distance(beads[..., :2], targets, maps) / radius
        return 0.5 * away - ring_area(beads) / (math.pi * radius**2)

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Of opening the first bag."""
        return self.opening_loss(layouts, snapshots, particle_q)

    # -- opening

    def pull_farthest(self, layout: Layout, snapshot: Snapshot) -> Action:
        """Pull the bead that is farthest from its target under the best of 32 maps, seen or not."""
        positions, targets, target_of = self._mapped(layout, snapshot)
        far = np.linalg.norm(positions - targets[target_of], axis=1)
        return self.pull_bead(layout, snapshot, int(np.argmax(far)), OVERSHOOT)

    def pull_visible(self, layout: Layout, snapshot: Snapshot) -> Action:
        """Pull a bead that the tip really takes: one that opens the hull much, and is far.

        Of all beads where the tip would take none at its place.
        """
        positions, targets, target_of = self._mapped(layout, snapshot)
        far = np.linalg.norm(positions - targets[target_of], axis=1)
        best: tuple[float, Action] | None = None
        for bead in self.met_beads(snapshot) or range(len(positions)):
            action = self.pull_bead(layout, snapshot, bead, OVERSHOOT)
            value = self._opened(positions, bead, action[3:5]) + far[bead] / _WORTH
            if best is None or value > best[0]:
                best = value, action
        assert best is not None
        return best[1]

    def pull_bead(self, layout: Layout, snapshot: Snapshot, bead: int, overshoot: float) -> Action:
        """Pull one bead to its target and `overshoot` [m] beyond, but not out of the picture."""
        positions, targets, target_of = self._mapped(layout, snapshot)
        start, target = positions[bead, :2], targets[target_of[bead], :2]
        way = target - start
        beyond = target + way * (overshoot / max(float(np.hypot(*way)), 1e-9))
        return pick_place(start, TABLE_GRID.in_view(beyond), stage=OPEN)

    def map_distance(self, layout: Layout, snapshot: Snapshot) -> float:
        """Mean distance of the beads from their targets, over the opening's radius."""
        positions, targets, target_of = self._mapped(layout, snapshot)
        mean = np.linalg.norm(positions[:, :2] - targets[target_of, :2], axis=1).mean()
        return float(mean) / self.bag.opening_radius

    def pulls(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Different pulls: far beads to their targets, others straight outwards."""
        positions, targets, target_of = self._mapped(layout, snapshot)
        far = np.linalg.norm(positions - targets[target_of], axis=1)
        met = self.met_beads(snapshot) or list(range(len(positions)))
        met.sort(key=lambda bead: -far[bead])
        chosen = met[: max(1, count // 4)]
        actions = [self.pull_bead(layout, snapshot, b, o) for b in chosen for o in (0.02, 0.05)]
        centre = self.ring_targets_of(layout).mean(axis=0)
        out = positions[:, :2] - centre
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
        rim = self.bag.opening_radius + OVERSHOOT
        gain = {b: self._opened(positions, b, centre + out[b] * rim) for b in met}
        pulled: list[int] = []
        for bead in sorted(met, key=lambda b: -gain[b]):
            apart = np.linalg.norm(positions[pulled, :2] - positions[bead, :2], axis=1)
            if len(actions) < count and (apart > 0.03).all():
                pulled.append(bead)
                place = TABLE_GRID.in_view(centre + out[bead] * (self.bag.opening_radius + 0.03))
                actions.append(pick_place(positions[bead, :2], place, stage=OPEN))
        return actions[:count]

    def _opened(self, positions: np.ndarray, bead: int, place: np.ndarray) -> float:
        """The opening, as a share of the circle, if nothing moved but one bead to `place` (2,)."""
        rim = positions[:, :2].copy()
        rim[bead] = place
        return hull_area(rim) / (math.pi * self.bag.opening_radius**2)

    def _mapped(
        self, layout: Layout, snapshot: Snapshot
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Beads (32, 3), targets (32, 3), and each bead's target under the best cyclic map."""
        positions = self.beads(snapshot)
        rim = self.ring_targets_of(layout)
        targets = np.column_stack([rim, np.zeros(len(rim))])
        maps = ring_maps(len(positions), reversals=False)
        bead, target = farthest_bead(positions, targets, maps)
        return positions, targets, (np.arange(len(positions)) - bead + target) % len(positions)

    # -- inserting

    def item_mask(self, layout: Layout, snapshot: Snapshot, item: int) -> np.ndarray:
        """Pixels (320, 160) of the item with this number among the scene's boxes."""
        boxes = [o for o in snapshot.objects if isinstance(o, Box)]
        ids = self._segments(layout, snapshot, boxes[item])
        return snapshot.images.segmentation == ids.start

    def insert(
        self,
        layout: Layout,
        snapshot: Snapshot,
        rng: np.random.Generator,
        clear: np.ndarray,
        item: int = 0,
    ) -> Action | None:
        """Put an item at a random place of `clear` (320, 160); None where it cannot be seen."""
        pick = visible_point(self.item_mask(layout, snapshot, item), rng)
        if pick is None:
            return None
        pixels = np.argwhere(clear)
        place = pixel_to_world(pixels[rng.integers(len(pixels))])
        yaws = self.place_yaws
        yaw = 2 * np.pi * rng.integers(yaws) / yaws if yaws > 1 else 0.0
        return pick_place(pick, place, stage=INSERT, place_yaw=float(yaw))

    # -- ground truth

    def bag_rows(self, layout: Layout, snapshot: Snapshot, number: int = 0) -> np.ndarray:
        """Rows (33, 3) of a bag: its beads, then its displacement from where it was dropped."""
        beads = self.beads(snapshot, number)
        particles = self.bag_of(snapshot, number).particles
        now = snapshot.particle_q[particles.start : particles.stop, :2].astype(float)
        start = layout.particle_q[particles.start : particles.stop, :2]
        a, b = start - start.mean(axis=0), now - now.mean(axis=0)
        turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        moved = pose_rows(now.mean(axis=0) - start.mean(axis=0), turn)
        return np.concatenate([pose_rows(beads, chain_yaw(beads, closed=True)), moved])


def _inside(bag: Bag, particle_q: np.ndarray, pose: np.ndarray) -> bool:
    """Whether a body with this pose (7,) has its centre inside a bag of a world's particles."""
    share = enclosed(pose[:3].astype(float), particle_q.astype(float), np.asarray(bag.faces))
    return share >= _INSIDE


def bag_mask(segmentation: np.ndarray, first: int, stop: int) -> np.ndarray:
    """Filled convex hull (320, 160) uint8 of pixels with ids first .. stop - 1; may be empty."""
    mask = np.zeros(SHAPE, np.uint8)
    pixels = np.argwhere((segmentation >= first) & (segmentation < stop))
    if len(pixels):
        hull = cv2.convexHull(pixels[:, ::-1].astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
    return mask


def enclosed(point: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of rays sideways and downwards from `point` (3,) that meet the triangles.

    vertices (P, 3) and faces (T, 3); near 1 inside a bag, near 0 beside it.
    """
    if not (np.isfinite(point).all() and np.isfinite(vertices).all()):
        return 0.0
    a = vertices[faces[:, 0]]
    u, v = vertices[faces[:, 1]] - a, vertices[faces[:, 2]] - a
    rays = _downward_rays()
    # all rays against all triangles (Moeller, Trumbore, 1997)
    h = np.cross(rays[:, None], v)
    det = np.einsum("tk,rtk->rt", u, h)
    det = np.where(np.abs(det) < 1e-14, 1e-14, det)
    s = point - a
    p = np.einsum("tk,rtk->rt", s, h) / det
    q = np.cross(s, u)
    w = np.einsum("rk,tk->rt", rays, q) / det
    far = np.einsum("tk,tk->t", v, q) / det
    hit = (p >= 0) & (w >= 0) & (p + w <= 1) & (far > 0)
    return float(hit.any(axis=1).mean())


@functools.cache
def _downward_rays() -> np.ndarray:
    """Unit vectors (R, 3) spread evenly over the lower half of the sphere (Fibonacci)."""
    k = np.arange(_RAYS) + 0.5
    z = -k / _RAYS
    turn = np.pi * (1 + math.sqrt(5)) * k
    level = np.sqrt(1 - z**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), z])


@functools.cache
def _shell(config: BagConfig) -> BagShell:
    return bag_shell(config)


@functools.cache
def _bead_mass(config: BagConfig) -> float:
    """Mass of a bead with its share of the shell [kg]."""
    shell = _shell(config)
    share = area_share(shell.vertices, shell.faces)[shell.ring]
    return float(config.bead_mass + config.mass * share.mean())
