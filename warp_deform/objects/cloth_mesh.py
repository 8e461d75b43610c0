"""Fabrics of any shape: a surface of triangles becomes a sheet of particles and springs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .cloth import Cloth, ClothConfig
from .sheet import Spring, add_sheet
from .surface import Surface, area_share, check_even, checked_surface, edges_and_pairs, rigid_pose

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here


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
    rest, faces = checked_surface(surface)
    pose = rigid_pose(a_T_b, "a fabric")
    edges, across = edges_and_pairs(faces)
    spacing = check_even(rest, edges, "a fabric")
    ranges = add_sheet(
        builder,
        rest,
        faces,
        (
            Spring(
                edges,
                config.structural_stiffness,
                shortest=config.shortest,
                longest=config.longest,
            ),
            Spring(across, config.bend_stiffness),
        ),
        rest @ pose[:3, :3].T + pose[:3, 3],
        masses=config.mass * area_share(rest, faces),
        radius=config.radius,
        skin=config.layer_distance(spacing) / 2,
        edge_gap=config.edge_contact * config.layer_distance(spacing),
        exclusion=config.exclusion * spacing,
        friction=config.friction,
        color=config.color,
    )
    return Cloth(config, *ranges, faces + ranges[0].start, ())
