"""bag-items-1 and bag-items-2: open a bag, put one or two items in, and carry it to a zone.

Source: Seita et al., ICRA 2021, appendix on bag-items.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.bag import Bag, add_bag
from ..objects.box import Box, BoxConfig, BoxPart, add_box
from ..objects.colors import BROWN, RED, Color
from ..objects.scene_object import SceneObject
from ..objects.zone import square_zone
from ..rendering.pixels import pixel_to_world
from ..robots.primitive import Outcome
from ..support.quaternion import quat_from_yaw, quat_yaw
from .bag_opening import BAG_ROWS, BagTask
from .bag_physics import CARRY, INSERT, OPEN
from .demonstrators import pick_place
from .free_space import FreeSpace, first_that_fits
from .ground_truth import Row, pose_rows
from .history import PastAction
from .losses import lengths
from .target_shapes import to_world
from .task import Action, Layout, Snapshot, Stage

if TYPE_CHECKING:
    import newton
    from torch import Tensor

__all__ = ["BagItems1", "BagItems2"]

_ZONE = 0.26  # [m] outer side
_INNER = 0.13  # [m] what is nearer to the zone's centre along both of its axes is inside
_ZONE_HEIGHT = (-0.01, 0.28)
_ROOM = 0.025  # [m] that an item needs beyond its size
_ROOM_SECOND = 0.015  # [m] the same where another item is in the bag


class BagItems1(BagTask):
    """The cube has to be in the zone with part of the bag: open it, put the cube in, carry it.

    A carry is an action that was placed, with the lift of that stage, and held the bag. The first
    one that leaves a bead or an item in the zone ends the episode, solved or not, as in the
    original. The score of the state after any other action is 0.

    Deliberate differences from the original: the bag's as in bag-alone-open; an item is set on the
    table instead of dropped; a start whose item cannot be seen is drawn again; an action that the
    arm cannot carry out counts with nothing, but does not end the episode.
    """

    name = "bag-items-1"
    instruction = "Put the cube into the bag and carry the bag to the zone."
    stages = (OPEN, INSERT, CARRY)
    success_score = 0.5
    version = 6
    looks_aloft = True
    ground_truth_rows = ((Row.POSE, 1), *BAG_ROWS, (Row.POSE, 1))
    objects: ClassVar[tuple[str, ...]] = ("bag", "cube")

    cubes: ClassVar[tuple[BoxConfig, ...]] = (
        BoxConfig(parts=(BoxPart((0.036, 0.036, 0.036)),), mass=0.02, friction=1.5, color=RED),
    )
    nominal: ClassVar[tuple[float, float]] = (0.04, 0.04)
    """Size [m] for which the demonstrator wants room, as in the original."""

    def add_objects(self, builder: newton.ModelBuilder) -> tuple[SceneObject, ...]:
        """Add the bag and the items."""
        bag = add_bag(builder, self.bag)
        return (bag, *(add_box(builder, c, (0.5, 0.4, -c.lowest)) for c in self.cubes))

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """A zone, a bag about to fall, and items that stand apart."""
        return first_that_fits(lambda: self._sample(rng, space))

    def _sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        # a zone in the way leaves no room in some of the draws
        zone_pose = np.array(space.sample(rng, _ZONE, _ZONE, extent=0.02))
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * _ZONE / 2
        space = space.occupy_polygon(to_world(corners, zone_pose))
        x, y, _ = space.sample(rng, self.bag.radius, self.bag.radius, extent=self.bag.radius)
        particles = self.drop(rng, x, y)
        space = space.occupy_disc((x, y), self.bag.radius)
        configs = self.draw_items(rng)
        poses = []
        for config in configs:
            width, depth, height = config.parts[0].size
            px, py, yaw = space.sample(rng, width, depth)
            poses.append([px, py, height / 2, *quat_from_yaw(yaw)])
            space = space.occupy_disc((px, py), float(np.hypot(width, depth)) / 2)
        return Layout(
            particle_q=particles,
            body_q=np.array(poses),
            targets=self.ring_targets(x, y),
            zones=(square_zone((zone_pose[0], zone_pose[1]), zone_pose[2], _ZONE),),
            pushes=(self.push(rng, 0),),
            settle_seconds=self.settle_seconds,
            frame=zone_pose,
            configs=dict(enumerate(configs, start=1)),
        )

    def draw_items(self, rng: np.random.Generator) -> tuple[BoxConfig, ...]:
        """The items of one episode."""
        return self.cubes

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Every item can be seen, and the task is not solved yet."""
        seen = all(self.item_mask(layout, snapshot, n).any() for n in range(len(self.cubes)))
        return seen and not self.solved(layout, snapshot)

    # -- scoring

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """After a carry, half the share of items in the zone and half that of beads; else 0."""
        if not self._carried(snapshot):
            return 0.0
        items, beads = self._shares(layout, snapshot)
        return 0.5 * items + 0.5 * beads

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether a carry left every item and at least one bead in the zone."""
        items, beads = self._shares(layout, snapshot)
        return self._carried(snapshot) and items == 1.0 and beads > 0.0

    def ended(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the last action was a carry that left a bead or an item in the zone."""
        return self._carried(snapshot) and max(self._shares(layout, snapshot)) > 0.0

    def enclosed(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether every item is inside the bag, and left the table in it at the last carry."""
        carries = [past for past in snapshot.history if self._is_carry(snapshot, past)]
        if not carries or not self.was_aloft(snapshot, carries[-1]):
            return False
        return bool(super().enclosed(layout, snapshot))

    def _carried(self, snapshot: Snapshot) -> bool:
        """Whether the last action was a carry, and the episode had not ended before."""
        history = snapshot.history
        return bool(history) and not snapshot.over and self._is_carry(snapshot, history[-1])

    def _is_carry(self, snapshot: Snapshot, past: PastAction) -> bool:
        held = None if past.held is None else snapshot.objects[past.held]
        placed = past.outcome is Outcome.PLACED and isinstance(held, Bag)
        return placed and self.stage_of(past.lift) is CARRY

    def _inserted(self, snapshot: Snapshot) -> int:
        """How often an item was inserted: picked at any lift, or meant to be."""
        return sum(
            self.stage_of(past.lift) is INSERT
            or (past.held is not None and isinstance(snapshot.objects[past.held], Box))
            for past in snapshot.history
        )

    def _shares(self, layout: Layout, snapshot: Snapshot) -> tuple[float, float]:
        """Shares of the items' centres and of the beads that are in the zone."""
        items = self._in_zone(layout, snapshot.body_q[:, :3])
        beads = self._in_zone(layout, self.beads(snapshot))
        return float(items.mean()), float(beads.mean())

    def _in_zone(self, layout: Layout, points: np.ndarray) -> np.ndarray:
        """Which of the points (n, 3) are in the zone."""
        x, y, yaw = _frame(layout)
        offset = points[:, :2] - [x, y]
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.abs(offset @ np.array([[c, -s], [s, c]]))
        low, high = _ZONE_HEIGHT
        return (local < _INNER).all(axis=1) & (points[:, 2] > low) & (points[:, 2] < high)

    # -- demonstrators

    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """Open the bag, put each item in once, then carry, as the original does.

        An item counts as put in as soon as that was tried; the bag is carried by a random bead.
        """
        if self.hidden(layout, snapshot):
            return None
        tried = self._inserted(snapshot)
        if tried >= len(self.cubes):
            return self._carry(layout, snapshot, rng)
        clear = self._clear(layout, snapshot, tried)
        if clear.any():
            return self.insert(layout, snapshot, rng, clear, tried)
        return self.pull_farthest(layout, snapshot) if tried == 0 else None

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The same with picks that the tip really meets, and with a look at what is in the bag.

        An item that did not get in, or fell out, is put in again. The bag is carried by the bead
        that lies across the bag from the items, so that they are below it when it hangs.
        """
        outside = self._outside(snapshot)
        if not outside:
            return self._carry_across(layout, snapshot)
        inserted = len(self.cubes) - len(outside)
        clear = self._clear(layout, snapshot, inserted, outside[0])
        if clear.any():
            action = self.insert(layout, snapshot, rng, clear, outside[0])
            if action is not None:
                return action
        return self.pull_visible(layout, snapshot)

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Pulls, places for the item once it fits the opening, then beads to carry by."""
        outside = self._outside(snapshot)
        if not outside:
            beads = self.met_beads(snapshot) or list(range(len(self.beads(snapshot))))
            spread = np.linspace(0, len(beads) - 1, min(count, len(beads))).round().astype(int)
            return [self._carry_by(layout, snapshot, beads[k]) for k in spread]
        clear = self._clear(layout, snapshot, len(self.cubes) - len(outside), outside[0])
        actions: list[Action] = []
        if clear.any():
            draws = (
                self.insert(layout, snapshot, rng, clear, outside[0]) for _ in range(count // 2)
            )
            actions = [action for action in draws if action is not None]
        return actions + self.pulls(layout, snapshot, rng, count - len(actions))

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """Solved with every item enclosed, else solved; items in the bag; how far it is open."""
        if self.solved(layout, snapshot):
            return 10.0 if self.enclosed(layout, snapshot) else 5.0
        outside = len(self._outside(snapshot))
        inside = len(self.cubes) - outside
        if not outside:
            return 2.0 * inside
        return 2.0 * inside + self.opening(snapshot) - 0.5 * self.map_distance(layout, snapshot)

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """Distance [m] of the items from the zone; of those that are outside first from the bag."""
        outside = self._outside_mask(snapshots, body_q)
        carried = lengths(body_q[..., :2] - _goals(layouts, body_q)[:, None]).mean(-1)
        centre = self.ring_of(snapshots, particle_q)[..., :2].mean(1)
        opened = self.opening_loss(layouts, snapshots, particle_q)
        away = lengths(body_q[..., :2] - centre[:, None])
        # where none is outside, what this comes to is not asked for
        inserted = (away * outside).sum(-1) / outside.sum(-1).clamp(min=1)
        return (opened + inserted).where(outside.any(-1), carried)

    def remaining(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """The loss above its least value; of a bag that lacks an item also its way to the zone."""
        centre = self.ring_of(snapshots, particle_q)[..., :2].mean(1)
        to_come = lengths(centre - _goals(layouts, body_q)) - self.least_loss
        loss = self.losses(layouts, snapshots, particle_q, body_q)
        return loss + to_come * self._outside_mask(snapshots, body_q).any(-1)

    def privileged_stage(self, segment: int, snapshot: Snapshot, previous: Stage | None) -> Stage:
        """A pick on an item is to insert it; the next pick on anything else carries, and so on."""
        items = snapshot.segments[-len(self.cubes) :]
        if any(segment in ids for ids in items):
            return INSERT
        if previous is INSERT:
            return CARRY
        return previous or OPEN

    def _outside_mask(self, snapshots: Sequence[Snapshot], like: Tensor) -> Tensor:
        """Which items (W, n) bool are not in the bag."""
        items, worlds = range(len(self.cubes)), [self._outside(s) for s in snapshots]
        return like.new_tensor([[n in world for n in items] for world in worlds]).bool()

    def _outside(self, snapshot: Snapshot) -> list[int]:
        """Numbers of the items that are not in the bag."""
        return [n for n in range(len(self.cubes)) if not self.inside_bag(snapshot, n)]

    def _clear(
        self, layout: Layout, snapshot: Snapshot, inserted: int, item: int | None = None
    ) -> np.ndarray:
        """Where (320, 160) the next item fits into the opening."""
        return self.clear_opening(layout, snapshot, self.nominal, _ROOM)

    def _carry(self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator) -> Action | None:
        """Carry the bag by a random visible bead."""
        seen = self.visible_beads(layout, snapshot)
        if not len(seen):
            return None
        return self._carry_by(layout, snapshot, seen[rng.integers(len(seen))])

    def _carry_across(self, layout: Layout, snapshot: Snapshot) -> Action | None:
        """Carry the bag by the visible bead across it from the items, of those that the tip takes.

        The shell below the lifted bead becomes a wall that the items slide down, and what lies
        beyond them the pocket that they fall into. Items on the bead's side of the bag's middle, or
        far from the rim beyond them, are caught in the mouth instead, and fall out of it.
        """
        seen = self.visible_beads(layout, snapshot).tolist()
        met = self.met_beads(snapshot)
        chosen = [bead for bead in seen if bead in met] or seen
        if not chosen:
            return None
        across = self.across(layout, snapshot)
        return self._carry_by(layout, snapshot, max(chosen, key=lambda bead: across[bead]))

    def across(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """How far (32,) [m] the items lie beyond the middle of the bag, seen from every bead.

        Less how far beyond them, along the same line, the bead opposite on the rim is.
        """
        rim, items = self.beads(snapshot)[:, :2], snapshot.body_q[:, :2].mean(axis=0)
        ids = self._segments(layout, snapshot, self.bag_of(snapshot))
        shown = snapshot.images.segmentation
        middle = pixel_to_world(np.argwhere((shown >= ids.start) & (shown < ids.stop)).mean(axis=0))
        way = items - rim
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        opposite = np.roll(rim, -len(rim) // 2, axis=0)
        return ((2 * items - middle - opposite) * way).sum(axis=1)

    def _carry_by(self, layout: Layout, snapshot: Snapshot, bead: int) -> Action:
        return pick_place(self.beads(snapshot)[bead], _frame(layout)[:2], stage=CARRY)

    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """(105,) or (108,): the zone, the bag's 32 beads and displacement, the items.

        Each is x, y, -yaw / 15.
        """
        frame = _frame(layout)
        yaws = np.array([quat_yaw(q[3:]) for q in snapshot.body_q])
        return np.concatenate(
            [
                pose_rows(frame, frame[2]),
                self.bag_rows(layout, snapshot),
                pose_rows(snapshot.body_q, yaws),
            ]
        ).ravel()


class BagItems2(BagItems1):
    """bag-items-1 with two boxes of different sizes, which may have to be turned."""

    name = "bag-items-2"
    instruction = "Put both cubes into the bag and carry the bag to the zone."
    place_yaws = 24
    max_actions = 9
    ground_truth_rows = ((Row.POSE, 1), *BAG_ROWS, (Row.POSE, 2))
    objects: ClassVar[tuple[str, ...]] = ("bag", "box", "box")
    cubes: ClassVar[tuple[BoxConfig, ...]] = (
        BoxConfig(parts=(BoxPart((0.035, 0.035, 0.03)),), mass=0.1, friction=1.5, color=BROWN),
        BoxConfig(parts=(BoxPart((0.035, 0.035, 0.03)),), mass=0.1, friction=1.5, color=BROWN),
    )

    def draw_items(self, rng: np.random.Generator) -> tuple[BoxConfig, ...]:
        """Two boxes whose two sides add up to 7 cm, each in a shade of brown."""
        configs = []
        for _ in self.cubes:
            side = float(rng.uniform(0.015, 0.055))
            shade = float(rng.uniform(0.5, 1.5))
            color: Color = tuple(min(255, round(shade * c)) for c in BROWN)  # type: ignore[assignment]
            part = BoxPart((side, 0.07 - side, 0.03))
            configs.append(BoxConfig(parts=(part,), mass=0.1, friction=1.5, color=color))
        return tuple(configs)

    def _clear(
        self, layout: Layout, snapshot: Snapshot, inserted: int, item: int | None = None
    ) -> np.ndarray:
        """The opening less the items that are in it, with less room for the second."""
        boxes = [o for o in snapshot.objects if isinstance(o, Box)]
        first = boxes[0 if item is None else item].config.parts[0].size
        if inserted == 0:
            return self.clear_opening(layout, snapshot, first[:2], _ROOM)
        hull = self.hull_mask(layout, snapshot)
        wanted = range(inserted) if item is None else [n for n in range(2) if n != item]
        free = hull.copy()
        for n in wanted:
            free[self.item_mask(layout, snapshot, n)] = 0
        less = self.erode(free, first[:2], _ROOM_SECOND)
        return less if less.any() else self.erode(hull, first[:2], _ROOM_SECOND)


def _frame(layout: Layout) -> np.ndarray:
    if layout.frame is None:
        raise ValueError("bag-items needs the pose of its zone")
    return layout.frame


def _goals(layouts: Sequence[Layout], like: Tensor) -> Tensor:
    """Where the zones are (W, 2) [m]."""
    return like.new_tensor(np.stack([_frame(layout)[:2] for layout in layouts]))
