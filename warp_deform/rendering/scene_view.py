"""Stills and video frames for people: table, objects and arm under a lamp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..objects.colors import BLUE, TABLE, Color
from .camera import Camera, look_at
from .drawables import Drawables
from .meshes import box_mesh
from .perspective import Perspective, RobotLink
from .pixels import BOUNDS
from .shading import Look

__all__ = ["STUDIO", "ArmMeshes", "SceneView", "scene_camera"]

FLOOR = -0.03
"""Height of the floor in scenes [m]: the table is a slab this thick."""
LINK_COLORS: tuple[Color, Color] = ((96, 100, 106), (200, 202, 206))
STUDIO = Look(
    floor=FLOOR,
    floor_color=(214, 211, 206),
    floor_checker=(214, 211, 206),
    table=False,
    horizon=(236, 237, 240),
    haze=4.0,
    lamp=(0.9, -1.0, 2.4),
    lamp_share=0.6,
    occlusion=0.9,
    gloss=0.25,
)


def scene_camera(size: tuple[int, int] = (720, 1280)) -> Camera:
    """A view over the whole table towards the arm, for pictures of `size` rows and columns."""
    return look_at((1.5, -0.8, 1.0), (0.4, -0.03, 0.17), size=size, vertical_fov=0.73)


class ArmMeshes:
    """An arm's meshes, ready for `SceneView`: one colour a link, dark and light in turn.

    Args:
        meshes: (link, link_T_mesh (4, 4), trimesh.Trimesh) of everything that is drawn, as from the
            `meshes` method of an arm; the link named "tip" is blue.
    """

    def __init__(self, meshes: Sequence[tuple[str, np.ndarray, Any]]) -> None:
        names = list(dict.fromkeys(link for link, _, _ in meshes))
        self._parts = [
            (
                link,
                link_T_mesh,
                np.array(mesh.vertices, np.float32),
                np.array(mesh.faces, np.int32),
                BLUE if link == "tip" else LINK_COLORS[names.index(link) % 2],
            )
            for link, link_T_mesh, mesh in meshes
        ]

    def at(self, link_poses: Mapping[str, np.ndarray]) -> list[RobotLink]:
        """The links where world_T_link (4, 4) or (1, 4, 4) of each name puts them."""
        return [
            (vertices, faces, np.reshape(link_poses[link], (4, 4)) @ link_T_mesh, color)
            for link, link_T_mesh, vertices, faces, color in self._parts
        ]


class SceneView:
    """Draws frames for people; keeps its buffers and meshes, so make one and use it again.

    Args:
        size: rows and columns of a frame
        camera: another view than `scene_camera` (its size wins)
        look: surroundings and light
        supersample: samples a pixel along both axes
    """

    def __init__(
        self,
        size: tuple[int, int] = (720, 1280),
        *,
        camera: Camera | None = None,
        look: Look = STUDIO,
        supersample: int = 2,
        device: str = "cpu",
    ) -> None:
        self.camera = scene_camera(size) if camera is None else camera
        self._renderer = Perspective(look=look, supersample=supersample, links=True, device=device)
        (x0, x1), (y0, y1), _ = BOUNDS
        thickness = -look.floor
        self._furniture: list[RobotLink] = []
        for (x, y), (dx, dy), color in (
            (((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0), TABLE),
            ((0.0, 0.0), (0.24, 0.24), (120, 122, 126)),
        ):
            vertices, faces = box_mesh((dx, dy, thickness))
            pose = np.eye(4)
            pose[:3, 3] = x, y, -thickness / 2
            self._furniture.append((vertices, faces, pose, color))

    def render(
        self,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
        robot_links: Sequence[RobotLink] = (),
    ) -> np.ndarray:
        """One frame, (H, W, 3) uint8.

        Args:
            particle_q: positions of the particles (P, 3) [m]
            body_q: poses of the bodies (B, 7), position [m] and quat_xyzw
            robot_links: of every link's mesh the vertices (V, 3) [m], faces (F, 3), world_T_link
                (4, 4) and 8-bit colour

        Raises:
            InputError: the state is not finite or has fewer particles or bodies than are drawn.
        """
        links = [*self._furniture, *robot_links]
        [color] = self._renderer.colors(drawables, particle_q, body_q, [self.camera], links)
        return color

    def forget(self) -> None:
        """Draw the next frame whole, whatever the last one was."""
        self._renderer.forget()
