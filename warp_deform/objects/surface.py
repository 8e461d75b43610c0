"""Surfaces of triangles: what can become a fabric, and which edges and boundaries it has.

The checks refuse by name what would only fail later.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..errors import InputError

__all__ = [
    "Surface",
    "area_share",
    "boundary_loops",
    "check_even",
    "checked_surface",
    "edges_and_pairs",
    "rigid_pose",
]

_MOST_VERTICES = 10_000
_MOST_UNEVEN = 20.0  # longest edge over the median one
_THINNEST = 1e-3  # least area of a triangle over that of an equilateral one of its longest edge


class Surface(Protocol):
    """A triangle mesh as trimesh and others have it: vertices (P, 3) [m] and faces (T, 3)."""

    @property
    def vertices(self) -> Any: ...

    @property
    def faces(self) -> Any: ...


def checked_surface(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (P, 3) and faces (T, 3) of a surface that can be a fabric."""
    rest, faces = np.asarray(surface.vertices, dtype=float), np.asarray(surface.faces)
    if rest.ndim != 2 or rest.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(
            f"a surface needs vertices (P, 3) and triangles (T, 3), got {rest.shape} and "
            f"{faces.shape}"
        )
    if not len(faces) or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("a surface needs at least one triangle of integer vertex numbers")
    if len(rest) > _MOST_VERTICES:
        raise InputError(
            f"a fabric holds at most {_MOST_VERTICES} vertices, the surface has {len(rest)}: "
            "simplify it"
        )
    if not np.isfinite(rest).all():
        bad = int(np.argmin(np.isfinite(rest).all(axis=1)))
        raise InputError(f"vertex {bad} of the surface is not finite")
    if faces.min() < 0 or faces.max() >= len(rest):
        raise InputError(f"a triangle names a vertex that is not among the {len(rest)}")
    loose = np.setdiff1d(np.arange(len(rest)), faces)
    if len(loose):
        raise InputError(f"vertex {loose[0]} of the surface belongs to no triangle ({len(loose)})")
    sides = np.linalg.norm(rest[faces] - np.roll(rest[faces], 1, axis=1), axis=2).max(axis=1)
    thin = _twice_area(rest, faces) <= _THINNEST * sides**2
    if thin.any():
        raise InputError(f"triangle {int(np.argmax(thin))} of the surface is degenerate")
    _, first, times = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    if times.max() > 1:
        raise InputError(f"triangle {first[np.argmax(times)]} of the surface occurs twice")
    return rest, faces.astype(int)


def edges_and_pairs(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), and pairs (B, 2) of vertices opposite each other across an inner edge.

    Raises:
        InputError: an edge belongs to three or more triangles.
    """
    sides, opposite = _sides(faces)
    edges, which, times = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    if times.max() > 2:
        a, b = edges[np.argmax(times)]
        raise InputError(
            f"the edge between vertices {a} and {b} belongs to {times.max()} triangles: the "
            "surface is not manifold"
        )
    order = np.argsort(which.ravel(), kind="stable")
    inner = times == 2
    start = np.cumsum(times) - times
    return edges, np.column_stack(
        [opposite[order[start[inner]]], opposite[order[start[inner] + 1]]]
    )


def boundary_loops(faces: np.ndarray) -> list[list[int]]:
    """The boundaries of a surface, each as its vertices in order, longest first.

    Args:
        faces: vertices of its triangles (F, 3)

    Raises:
        InputError: two boundaries meet in a vertex.
    """
    sides, _ = _sides(faces)
    edges, times = np.unique(sides, axis=0, return_counts=True)
    neighbours: dict[int, list[int]] = {}
    for a, b in edges[times == 1].tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    for vertex, others in neighbours.items():
        if len(others) != 2:
            raise InputError(f"boundaries of the surface meet in vertex {vertex}: part them")
    loops = []
    while neighbours:
        loop = [min(neighbours)]
        ahead = neighbours.pop(loop[0])[0]
        while ahead != loop[0]:
            loop.append(ahead)
            one, other = neighbours.pop(ahead)
            ahead = other if one == loop[-2] else one
        loops.append(loop)
    return sorted(loops, key=len, reverse=True)


def rigid_pose(a_T_b: np.ndarray | None, what: str) -> np.ndarray:
    """The transform (4, 4), identity for None; InputError where it is not rigid."""
    pose = np.eye(4) if a_T_b is None else np.asarray(a_T_b, dtype=float)
    turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
    if not np.isfinite(pose).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
        raise InputError(f"a_T_b of {what} must be a rigid transform (4, 4)")
    return pose


def area_share(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Share (P,) of the surface's area that belongs to each vertex."""
    share = np.bincount(faces.ravel(), np.repeat(_twice_area(rest, faces), 3), minlength=len(rest))
    return share / share.sum()


def check_even(rest: np.ndarray, edges: np.ndarray, what: str) -> float:
    """The median length of `edges` [m]; InputError where they are too different in length."""
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    spacing = float(np.median(length))
    if length.max() > _MOST_UNEVEN * spacing or length.min() * _MOST_UNEVEN < spacing:
        raise InputError(
            f"edges of {what} must be alike: they are {length.min():.4g} to {length.max():.4g} m "
            f"long, the median is {spacing:.4g} m; remesh the surface"
        )
    return spacing


def _sides(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every side (3 T, 2) of every triangle, sorted within, and the corner opposite to it."""
    sides = np.sort(np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]), axis=1)
    return sides, np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])


def _twice_area(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (rest[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)
