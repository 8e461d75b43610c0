"""Fabrics of any shape: a surface of triangles becomes a sheet of particles and springs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..errors import InputError
from .cloth import Cloth, ClothConfig
from .sheet import Spring, add_sheet

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here

_MOST_VERTICES = 10_000
_MOST_UNEVEN = 20.0  # longest edge over the median one
_THINNEST = 1e-3  # least area of a triangle over that of an equilateral one of its longest edge


class Surface(Protocol):
    """A triangle mesh as trimesh and others have it: vertices (P, 3) [m] and faces (T, 3)."""

    @property
    def vertices(self) -> Any: ...

    @property
    def faces(self) -> Any: ...


def add_cloth_mesh(
    builder: newton.ModelBuilder,
    config: ClothConfig,
    surface: Surface,
    a_T_b: np.ndarray | None = None,
) -> Cloth:
    """Add a fabric that is undeformed in the shape of `surface`, placed by `a_T_b` (4, 4).

    Of `config`, rows, columns and side do not count: edges are structural, opposite vertices across
    an edge are joined by bending springs, the mass is spread by area, and the spacing is the median
    edge. Edges of similar length work best.

    Raises:
        InputError: the surface is not one that can be a fabric, by name: wrong shapes, not finite,
            too many vertices, indices out of range, vertices without a triangle, degenerate or
            repeated triangles, edges of three or more triangles, very uneven edges; or the pose is
            not a rigid one.
    """
    rest, faces = _checked(surface)
    pose = np.eye(4) if a_T_b is None else np.asarray(a_T_b, dtype=float)
    turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
    if not np.isfinite(pose).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
        raise InputError("a_T_b of a fabric must be a rigid transform (4, 4)")
    edges, across = _adjacency(faces)
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    spacing = float(np.median(length))
    if length.max() > _MOST_UNEVEN * spacing or length.min() * _MOST_UNEVEN < spacing:
        raise InputError(
            f"edges of a fabric must be alike: they are {length.min():.4g} to {length.max():.4g} m "
            f"long, the median is {spacing:.4g} m; remesh the surface"
        )
    area = _twice_area(rest, faces)
    share = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(rest))
    ranges = add_sheet(
        builder,
        rest,
        faces,
        (
            Spring(
                edges, config.structural_stiffness,
                shortest=config.shortest, longest=config.longest,
            ),
            Spring(across, config.bend_stiffness),
        ),
        rest @ turn.T + pose[:3, 3],
        masses=config.mass * share / share.sum(),
        radius=config.radius,
        skin=config.layer_distance(spacing) / 2,
        edge_gap=config.edge_contact * config.layer_distance(spacing),
        exclusion=config.exclusion * spacing,
        friction=config.friction,
        color=config.color,
    )  # fmt: skip
    return Cloth(config, *ranges, faces + ranges[0].start, ())


def _checked(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
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


def _twice_area(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (rest[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _adjacency(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), and pairs (B, 2) of vertices opposite each other across an inner edge.

    Raises:
        InputError: an edge belongs to three or more triangles.
    """
    sides = np.sort(np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]), axis=1)
    opposite = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
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
