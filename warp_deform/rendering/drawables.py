"""What a picture of one world shows, apart from where things are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..objects.bag import Bag
from ..objects.box import Box
from ..objects.cable import Cable
from ..objects.cloth import Cloth
from ..objects.colors import TABLE, Color
from ..objects.scene_object import SceneObject
from ..objects.zone import Zone

__all__ = ["FIRST_SEGMENT", "WORKSPACE_SEGMENT", "Drawables"]

WORKSPACE_SEGMENT = 1
"""Segmentation id of the bare table, as in the original."""
FIRST_SEGMENT = 4
"""Segmentation id of the first object or zone; the others follow in creation order."""
LINK_SHARE = 0.5  # radius of a rod between beads, as a share of the bead's


@dataclass(frozen=True, eq=False)
class Drawables:
    """Spheres, boxes, sheets and flat marks of one world, with a segmentation id and a colour each.

    Attributes:
        sphere_particle: which particle is a sphere's centre (S,) int32
        sphere_radius: (S,) float32 [m]
        sphere_segment: (S,) int32
        box_body: which body a box moves with (B,) int32
        box_pose: centre [m] and quat_xyzw of the box in the body's frame (B, 7) float32
        box_half: half sides (B, 3) float32 [m]
        box_segment: (B,) int32
        quad_corners: of marks that are fixed in the world (Q, 4, 3) float32 [m]
        quad_segment: (Q,) int32
        triangle_particle: corners of two-sided sheets (T, 3) int32
        triangle_segment: (T,) int32
        link_particle: beads that scenes (not the top-down pictures) join by a thin rod (L, 2) int32
        link_radius: (L,) float32 [m]
        link_segment: whose colour the rod takes (L,) int32
        palette: colour of each segmentation id (256, 3) uint8
        segments: for every argument of `of`, in its order, the ids it got
    """

    sphere_particle: np.ndarray
    sphere_radius: np.ndarray
    sphere_segment: np.ndarray
    box_body: np.ndarray
    box_pose: np.ndarray
    box_half: np.ndarray
    box_segment: np.ndarray
    quad_corners: np.ndarray
    quad_segment: np.ndarray
    palette: np.ndarray
    segments: tuple[range, ...]
    triangle_particle: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    triangle_segment: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    link_particle: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    link_radius: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    link_segment: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))

    @classmethod
    def of(cls, objects: Sequence[SceneObject | Zone]) -> Drawables:
        """Drawables of `objects` in creation order; every bead, body, sheet and zone has an id.

        A bag's shell comes first, then its beads around the opening.
        """
        spheres: list[tuple[int, float, int]] = []
        links: list[tuple[int, int, float, int]] = []
        boxes: list[tuple[int, tuple[float, ...], tuple[float, ...], int]] = []
        quads: list[np.ndarray] = []
        quad_segments: list[int] = []
        sheets: list[np.ndarray] = []
        sheet_segments: list[int] = []
        palette = np.zeros((256, 3), np.uint8)
        palette[WORKSPACE_SEGMENT] = TABLE
        segments: list[range] = []
        segment = FIRST_SEGMENT
        for item in objects:
            first = segment
            if isinstance(item, Cable):
                config, beads = item.config, item.particles
                for particle, color in zip(beads, config.colors(), strict=True):
                    spheres.append((particle, config.visual_radius, segment))
                    palette[segment] = color
                    segment += 1
                for i in range(item.count if config.closed else item.count - 1):
                    # the colour of the body, not of a marked end
                    owner = first + (max(i, 1) if not config.closed else i)
                    neighbour = beads[(i + 1) % item.count]
                    links.append((beads[i], neighbour, LINK_SHARE * config.visual_radius, owner))
            elif isinstance(item, Box):
                for part in item.config.parts:
                    pose = (*part.offset, 0.0, 0.0, 0.0, 1.0)
                    half = tuple(side / 2 for side in part.size)
                    boxes.append((item.body, pose, half, segment))
                palette[segment] = item.config.color
                segment += 1
            elif isinstance(item, Cloth | Bag):
                sheets.append(item.faces)
                sheet_segments += [segment] * len(item.faces)
                palette[segment] = item.config.color
                segment += 1
                if isinstance(item, Bag):
                    for bead in item.ring:
                        spheres.append((bead, item.config.visual_radius, segment))
                        palette[segment] = item.config.bead_color
                        segment += 1
            else:
                quads.append(item.corners)
                quad_segments += [segment] * len(item.corners)
                palette[segment] = item.color
                segment += 1
            segments.append(range(first, segment))
        if segment > 256:
            raise ValueError(f"{segment - FIRST_SEGMENT} objects do not fit 8-bit segmentation ids")
        return cls(
            sphere_particle=np.array([s[0] for s in spheres], np.int32),
            sphere_radius=np.array([s[1] for s in spheres], np.float32),
            sphere_segment=np.array([s[2] for s in spheres], np.int32),
            box_body=np.array([b[0] for b in boxes], np.int32),
            box_pose=np.array([b[1] for b in boxes], np.float32).reshape(-1, 7),
            box_half=np.array([b[2] for b in boxes], np.float32).reshape(-1, 3),
            box_segment=np.array([b[3] for b in boxes], np.int32),
            quad_corners=np.concatenate([*quads, np.zeros((0, 4, 3))]).astype(np.float32),
            quad_segment=np.array(quad_segments, np.int32),
            palette=palette,
            segments=tuple(segments),
            triangle_particle=np.concatenate([*sheets, np.zeros((0, 3))]).astype(np.int32),
            triangle_segment=np.array(sheet_segments, np.int32),
            link_particle=np.array([k[:2] for k in links], np.int32).reshape(-1, 2),
            link_radius=np.array([k[2] for k in links], np.float32),
            link_segment=np.array([k[3] for k in links], np.int32),
        )

    def marked(self, first: int, count: int, radius: float, color: Color) -> Drawables:
        """The same with spheres of one colour at further particles, `count` from `first` on."""
        segment = max((ids.stop for ids in self.segments), default=FIRST_SEGMENT)
        if segment > 255:
            raise ValueError("no segmentation id is left for marks")
        palette = self.palette.copy()
        palette[segment] = color
        more = np.arange(first, first + count, dtype=np.int32)
        return replace(
            self,
            sphere_particle=np.concatenate([self.sphere_particle, more]),
            sphere_radius=np.append(self.sphere_radius, np.full(count, radius, np.float32)),
            sphere_segment=np.append(self.sphere_segment, np.full(count, segment, np.int32)),
            palette=palette,
            segments=(*self.segments, range(segment, segment + 1)),
        )
