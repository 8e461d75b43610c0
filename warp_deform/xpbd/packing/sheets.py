"""Reads the triangles of a `newton.Model`: fabrics, for contact only.

How a fabric stretches and bends is its springs; Newton's triangle stiffness is not used.
"""

from __future__ import annotations

from typing import Any

import newton
import numpy as np

from ...errors import InputError
from ...objects.attributes import NAMESPACE

__all__ = ["Sheets"]

_MOST_PARTICLES = 20_000  # of a world with triangles; the pairs of a world are counted in int32


class Sheets:
    """Triangles of all worlds of a model, to be read world by world."""

    def __init__(self, model: newton.Model) -> None:
        ours = getattr(model, NAMESPACE)
        self.count = model.tri_count
        if self.count:
            self.triangles = model.tri_indices.numpy().reshape(-1, 3)
            self.friction = ours.triangle_friction.numpy()
            skin = ours.particle_skin.numpy()
            self.skin = np.where(skin > 0, skin, model.particle_radius.numpy())
            self.rest = ours.particle_rest.numpy()
            self.owner = ours.particle_object.numpy()
            self.exclusion = ours.particle_exclusion.numpy()
            self.edge_gap = ours.particle_edge_gap.numpy()

    def of(self, ids: np.ndarray, local: np.ndarray) -> dict[str, Any]:
        """Fields `sheet_*` of `WorldTopology` for the world of particles `ids`.

        Raises:
            InputError: a triangle is degenerate in the rest shape, or there are too many particles.
        """
        mine = np.isin(self.triangles[:, 0], ids) if self.count else np.zeros(0, bool)
        if not mine.any():
            none = np.zeros(0)
            return {
                "sheet_triangle": np.zeros((0, 3), int),
                "sheet_friction": none,
                "sheet_skin": none,
                "sheet_rest": np.zeros((0, 3)),
                "sheet_owner": np.zeros(0, int),
                "sheet_exclusion": none,
                "sheet_cell": 0.0,
                "sheet_edge": np.zeros((0, 2), int),
                "sheet_edge_gap": none,
            }
        if len(ids) > _MOST_PARTICLES:
            raise InputError(
                f"a world with triangles holds at most {_MOST_PARTICLES} particles, got {len(ids)}"
            )
        triangles = self.triangles[mine]
        corners = self.rest[triangles]
        twice = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        if not (twice > 0).all():
            bad = triangles[np.argmin(twice > 0)]
            raise InputError(
                f"triangle of particles {bad.tolist()} has no area in the rest shape: triangles "
                "need the attribute particle_rest, as add_cloth and add_cloth_mesh set it"
            )
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        meeting = np.unique(np.sort(sides[self.edge_gap[sides].min(axis=1) > 0], axis=1), axis=0)
        return {
            "sheet_triangle": local[triangles],
            "sheet_friction": self.friction[mine],
            "sheet_skin": self.skin[ids],
            "sheet_rest": self.rest[ids],
            "sheet_owner": self.owner[ids],
            "sheet_exclusion": self.exclusion[ids],
            "sheet_edge": local[meeting],
            "sheet_edge_gap": self.edge_gap[ids],
            "sheet_cell": float(np.median(edges)),
        }
