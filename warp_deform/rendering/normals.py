"""Shading normals of rigid meshes: smooth where they are round, sharp at their edges."""

from __future__ import annotations

import numpy as np

__all__ = ["crease_normals"]


def crease_normals(vertices: np.ndarray, faces: np.ndarray, *, crease: float = 0.6) -> np.ndarray:
    """Unit normal of every corner of every face, (F, 3, 3).

    A corner's normal is the area-weighted mean over the faces that meet there and whose normal is
    within `crease` [rad] of its own face's. Vertices at the same place count as one, as STL files
    repeat them.
    """
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    length = np.linalg.norm(area, axis=1, keepdims=True)
    unit = area / np.maximum(length, 1e-30)
    _, place = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    corner_place = place.reshape(-1)[faces].reshape(-1)
    # all pairs (i, j) of corners at one place: j runs over the whole group for every i
    order = np.argsort(corner_place, kind="stable")
    count = np.bincount(corner_place)
    start = np.concatenate([[0], np.cumsum(count)])[corner_place]
    size = count[corner_place]
    i = np.repeat(np.arange(len(corner_place)), size)
    within = np.arange(len(i)) - np.repeat(np.cumsum(size) - size, size)
    j = order[np.repeat(start, size) + within]
    smooth = (unit[i // 3] * unit[j // 3]).sum(axis=1) >= np.cos(crease)
    total = np.zeros((len(corner_place), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(
            i[smooth], weights=area[j[smooth] // 3, axis], minlength=len(corner_place)
        )
    size_of = np.linalg.norm(total, axis=1, keepdims=True)
    normal = np.where(size_of > 0, total / np.maximum(size_of, 1e-30), [0.0, 0.0, 1.0])
    return normal.reshape(-1, 3, 3)
