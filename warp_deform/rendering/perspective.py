"""Pinhole pictures of one world: colour, depth and segmentation, with shadows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ..errors import InputError
from .camera import Camera, look_at
from .drawables import Drawables
from .geometry import Geometry, HostArray
from .meshes import Mesh
from .occlusion import ABOVE_SPREAD, LAMP_SPREAD, OccluderBuffer, Occluders
from .patches import LOOKS, PATCH, find_stale
from .pinhole import view_of
from .shading import Lighting, Look, lighting_of, shade
from .zbuffer import ZBuffer

__all__ = ["RGBD", "Perspective", "RobotLink"]

RobotLink = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int, int]]
"""A rigid mesh: vertices (V, 3) [m], faces (F, 3), world_T_mesh (4, 4), colour as 8-bit RGB."""

FAR = 10.0  # [m]; the original's far plane, and the depth of what is farther or nothing
SHADOW_SIZE = 1024  # samples along a side of the lamp's z-buffer
SHADOW_REACH = 0.95  # [m] around the table's centre that it covers
ABOVE_SIZE = 512  # samples along a side of the view from above
ABOVE_REACH = 0.7  # [m]


@dataclass(frozen=True, eq=False)
class RGBD:
    """What one camera sees.

    Attributes:
        color: (H, W, 3) uint8
        depth: (H, W) float32, along the viewing axis, at most 10 [m]
        segmentation: (H, W) uint8: 0 floor or nothing, 1 table, 2 robot, objects and zones from 4
    """

    color: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray


class Perspective:
    """Draws pinhole pictures; keeps its buffers and meshes, so make one and use it again.

    An instance is for one thread at a time. Meshes are recognised by the identity of their arrays:
    hand in the same arrays for every picture, and they are uploaded once. Where a picture has the
    drawables, meshes and camera (the same objects) of the one before, only the patches that look
    different are shaded again; the bits are those of a picture drawn whole. Shadows fall within
    about a metre of the table's centre.

    Args:
        look: surroundings and light
        supersample: samples a pixel along both axes (colour only: depth and segmentation need 1)
        links: whether rods are drawn between beads.
    """

    def __init__(
        self,
        *,
        look: Look | None = None,
        supersample: int = 1,
        links: bool = False,
        device: str = "cpu",
    ) -> None:
        if supersample < 1:
            raise InputError(f"supersample must be at least 1, got {supersample}")
        look = Look() if look is None else look
        self._device = wp.get_device(device)
        self._supersample, self._links = supersample, links
        self._lighting = lighting_of(look)
        self._lamp, self._above = (
            OccluderBuffer(
                _centred(eye, size, reach), spread=spread, links=links, device=self._device
            )
            for eye, size, reach, spread in (
                (look.lamp, SHADOW_SIZE, SHADOW_REACH, LAMP_SPREAD),
                # a little off the vertical, which has no right or left
                ((0.5, -1e-3, 3.0), ABOVE_SIZE, ABOVE_REACH, ABOVE_SPREAD),
            )
        )
        self._whole = False
        self._pictures: dict[tuple[tuple[int, int], int], _Picture] = {}
        self._meshes: dict[tuple[int, int], Mesh] = {}
        self._geometries: WeakKeyDictionary[Drawables, tuple[Geometry, list[Mesh]]] = (
            WeakKeyDictionary()
        )

    def render(
        self,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
        cameras: Sequence[Camera],
        robot_links: Sequence[RobotLink] = (),
    ) -> list[RGBD]:
        """One picture per camera.

        Args:
            particle_q: positions of the particles (P, 3) [m]
            body_q: poses of the bodies (B, 7), position [m] and quat_xyzw

        Raises:
            InputError: the state is not finite or has fewer particles or bodies than are drawn.
        """
        pictures = self._draw(drawables, particle_q, body_q, cameras, robot_links)
        return [picture.read() for picture in pictures]

    def colors(
        self,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
        cameras: Sequence[Camera],
        robot_links: Sequence[RobotLink] = (),
    ) -> list[np.ndarray]:
        """The colours alone, (H, W, 3) uint8 per camera; see `render`."""
        pictures = self._draw(drawables, particle_q, body_q, cameras, robot_links)
        return [picture.color.read() for picture in pictures]

    def forget(self) -> None:
        """Draw the next picture whole, whatever the last one was."""
        self._whole = False

    def _draw(
        self,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
        cameras: Sequence[Camera],
        robot_links: Sequence[RobotLink],
    ) -> list[_Picture]:
        whole, self._whole = self._whole, False  # an interrupted picture is no base for the next
        geometry = self._geometry(drawables, len(particle_q), len(body_q), robot_links)
        geometry.move(particle_q, body_q)
        geometry.move_scene(np.array([link[2] for link in robot_links]))
        if not whole:
            geometry.previous_state = None
        self._lamp.draw(geometry)
        if self._lighting.occlusion > 0:
            self._above.draw(geometry)
        # cameras of one size have a picture each, so that every one finds its own again
        sizes: Counter[tuple[int, int]] = Counter()
        pictures = []
        for camera in cameras:
            key = camera.size, sizes[camera.size]
            sizes[camera.size] += 1
            picture = self._pictures.get(key)
            if picture is None or picture.camera is not camera:
                picture = self._pictures[key] = _Picture(
                    camera, supersample=self._supersample, links=self._links, device=self._device
                )
            picture.draw(geometry, self._lighting, self._lamp.seen, self._above.seen)
            pictures.append(picture)
        self._whole = True
        return pictures

    def _geometry(
        self, drawables: Drawables, particles: int, bodies: int, robot_links: Sequence[RobotLink]
    ) -> Geometry:
        keys = [(id(link[0]), id(link[1])) for link in robot_links]
        # a Mesh keeps its arrays alive, so an id in use cannot name another array
        self._meshes = {
            key: self._meshes.get(key) or Mesh(vertices, faces, rgb)
            for key, (vertices, faces, _, rgb) in zip(keys, robot_links, strict=True)
        }
        meshes = [self._meshes[key] for key in keys]
        cached = self._geometries.get(drawables)
        if cached:
            geometry, known = cached
            if (geometry.particle_count, geometry.body_count) == (particles, bodies) and (
                [id(m) for m in known] == [id(m) for m in meshes]
            ):
                return geometry
        geometry = Geometry(drawables, particles, bodies, self._device, meshes=meshes)
        self._geometries[drawables] = geometry, meshes
        return geometry


class _Picture:
    """What one camera saw last, and what it takes to bring that up to date."""

    def __init__(self, camera: Camera, *, supersample: int, links: bool, device: wp.Device) -> None:
        self.camera, self._supersample, self._device = camera, supersample, device
        view = view_of(camera, supersample=supersample)
        self._buffer = ZBuffer(view, side=PATCH * supersample, links=links, device=device)
        patches = self._buffer.shape
        self._stale = HostArray(patches, wp.uint8, device)
        self._list = HostArray(patches[0] * patches[1], wp.int32, device)
        self._looks = wp.zeros((patches[0] * patches[1], LOOKS), dtype=wp.int32, device=device)
        self.color = HostArray(camera.size, wp.vec3ub, device)
        self._depth = HostArray(camera.size, wp.float32, device)
        self._segmentation = HostArray(camera.size, wp.uint8, device)

    def draw(
        self, geometry: Geometry, lighting: Lighting, lamp: Occluders, above: Occluders
    ) -> None:
        """Shade the patches that look different; lamp and above: of the same state."""
        buffer = self._buffer
        buffer.draw(geometry)
        wp.launch(
            find_stale,
            buffer.shape,
            inputs=[buffer.tiles, lamp, above, self._looks, self._stale.array],
            device=self._device,
        )
        stale = np.flatnonzero(self._stale.read())
        if not len(stale):
            return
        self._list.mirror[: len(stale)] = stale
        self._list.write(self._list.mirror)
        wp.launch(
            shade,
            len(stale),
            inputs=[
                geometry.scene,
                buffer.view,
                lighting,
                self._supersample,
                geometry.triangle_count,
                geometry.sphere_count,
                FAR,
                buffer.keys,
                lamp,
                above,
                self._list.array,
                buffer.shape[1],
                self._looks,
                self.color.array,
                self._depth.array,
                self._segmentation.array,
            ],
            device=self._device,
        )

    def read(self) -> RGBD:
        """A copy of the picture."""
        return RGBD(self.color.read(), self._depth.read(), self._segmentation.read())


def _centred(eye: tuple[float, float, float], size: int, reach: float) -> Camera:
    """Square view from `eye` of the table's centre and `reach` [m] around it."""
    distance = float(np.linalg.norm(np.subtract(eye, (0.5, 0.0, 0.0))))
    return look_at(
        eye, (0.5, 0.0, 0.0), size=(size, size), vertical_fov=2 * float(np.arctan(reach / distance))
    )
