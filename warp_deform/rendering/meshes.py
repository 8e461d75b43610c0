"""Rigid triangle meshes that scenes show beside what is simulated, and the mesh of a box."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .normals import crease_normals

__all__ = ["BOX_FACES", "Mesh", "box_mesh"]

# corners of a box in units of its half sides, and its faces, outwards
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Mesh:
    """A rigid triangle mesh in its own frame.

    Attributes:
        vertices: (V, 3) [m]
        faces: (F, 3)
        rgb: colour, 0 to 255
    """

    vertices: np.ndarray
    faces: np.ndarray
    rgb: tuple[int, int, int]

    @cached_property
    def normals(self) -> np.ndarray:
        """Shading normals (F, 3, 3)."""
        return crease_normals(self.vertices, self.faces)

    @cached_property
    def closed(self) -> bool:
        """Whether the faces enclose a volume and look outwards: no back of one can be seen."""
        _, names = np.unique(self.vertices, axis=0, return_inverse=True)
        corners = names.reshape(-1)[self.faces]
        edges = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
        forth = np.unique(edges, axis=0, return_counts=True)
        back = np.unique(edges[:, ::-1], axis=0, return_counts=True)
        a, b, c = np.moveaxis(np.asarray(self.vertices, float)[self.faces], 1, 0)
        volume = np.einsum("ij,ij", a, np.cross(b, c))
        return all(map(np.array_equal, forth, back)) and bool(volume > 0)


def box_mesh(size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) [m] and faces (12, 3) of a box around the origin."""
    return _CORNERS * np.float32(0.5) * np.array(size, np.float32), BOX_FACES.copy()
