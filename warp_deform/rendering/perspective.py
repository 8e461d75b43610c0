"""Pinhole pictures of one world: colour, depth and segmentation, with shadows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ..errors import InputError
from .camera import Camera, look_at
from .drawables import Drawables
from .geometry import Geometry, HostArray, Mesh
from .occlusion import draw_occluders, occluders
from .pinhole import draw, view_of
from .shading import Look, lighting_of, shade

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

    color (H, W, 3) uint8; depth (H, W) float32 [m] along the viewing axis, at most 10;
    segmentation (H, W) uint8: 0 floor or nothing, 1 table, 2 robot, objects and zones from 4
    """

    color: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray


class Perspective:
    """Draws pinhole pictures; keeps its buffers and meshes, so make one and use it again.

    look: surroundings and light; supersample: samples a pixel along both axes (colour only: depth
    and segmentation need 1); links: whether rods are drawn between beads.

    An instance is for one thread at a time. Meshes are recognised by the identity of their arrays:
    hand in the same arrays for every picture, and they are uploaded once. Shadows fall within about
    a metre of the table's centre.
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
        self._lamp = occluders(_centred(look.lamp, SHADOW_SIZE, SHADOW_REACH), self._device)
        # a little off the vertical, which has no right or left
        self._above = occluders(_centred((0.5, -1e-3, 3.0), ABOVE_SIZE, ABOVE_REACH), self._device)
        self._frames: dict[tuple[int, int], tuple[wp.array, HostArray, HostArray, HostArray]] = {}
        self._meshes: dict[tuple[int, int], Mesh] = {}
        self._geometries: WeakKeyDictionary[Drawables, tuple[Geometry, list[Mesh]]] = (
            WeakKeyDictionary()
        )

    def _buffer(self, size: tuple[int, int]) -> wp.array:
        return wp.zeros(size, dtype=wp.int64, device=self._device)

    def render(
        self,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
        cameras: Sequence[Camera],
        robot_links: Sequence[RobotLink] = (),
    ) -> list[RGBD]:
        """One picture per camera.

        particle_q (P, 3) [m]; body_q (B, 7) position [m] and quat_xyzw

        Raises:
            InputError: the state is not finite or has fewer particles or bodies than are drawn.
        """
        geometry = self._geometry(drawables, len(particle_q), len(body_q), robot_links)
        geometry.move(particle_q, body_q)
        geometry.move_scene(np.array([link[2] for link in robot_links]))
        draw_occluders(self._lamp, geometry, links=self._links)
        if self._lighting.occlusion > 0:
            draw_occluders(self._above, geometry, links=self._links)
        return [self._picture(geometry, camera) for camera in cameras]

    def _picture(self, geometry: Geometry, camera: Camera) -> RGBD:
        view = view_of(camera, supersample=self._supersample)
        if camera.size not in self._frames:
            self._frames[camera.size] = (
                self._buffer((view.rows, view.columns)),
                HostArray(camera.size, wp.vec3ub, self._device),
                HostArray(camera.size, wp.float32, self._device),
                HostArray(camera.size, wp.uint8, self._device),
            )
        buffer, color, depth, segmentation = self._frames[camera.size]
        draw(geometry, view, buffer, links=self._links)
        wp.launch(
            shade,
            camera.size,
            inputs=[
                geometry.scene,
                view,
                self._lighting,
                self._supersample,
                geometry.triangle_count,
                geometry.sphere_count,
                FAR,
                buffer,
                self._lamp,
                self._above,
                color.array,
                depth.array,
                segmentation.array,
            ],
            device=self._device,
        )
        return RGBD(color.read(), depth.read(), segmentation.read())

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


def _centred(eye: tuple[float, float, float], size: int, reach: float) -> Camera:
    """Square view from `eye` of the table's centre and `reach` [m] around it."""
    distance = float(np.linalg.norm(np.subtract(eye, (0.5, 0.0, 0.0))))
    return look_at(
        eye, (0.5, 0.0, 0.0), size=(size, size), vertical_fov=2 * float(np.arctan(reach / distance))
    )
