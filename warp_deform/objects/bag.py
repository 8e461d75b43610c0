"""Bags: a shell of triangles whose opening is a ring of beads.

Source: Seita et al., ICRA 2021 (a sphere of radius 0.1 m cut open, 32 beads around the opening,
masses, colours). The original's 353 vertices crowd at the bottom pole; here the rows near it are
coarser, which leaves 313 vertices, 592 triangles and no edge shorter than 1 cm.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import BELOW_ONE, NOT_NEGATIVE, POSITIVE, SHARE, Interval, check_fields
from .attributes import SpringMode
from .colors import BLUE, YELLOW, Color
from .sheet import Spring, add_sheet
from .surface import (
    Surface,
    area_share,
    boundary_loops,
    check_even,
    checked_surface,
    edges_and_pairs,
    rigid_pose,
)

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here

_AROUND = 32  # beads, and vertices of all rows but those at the pole
_ROW_ANGLE = math.radians(11.25)
_COARSE = {1: 8, 2: 16}  # vertices of the rows next to the pole


@dataclass(frozen=True, kw_only=True)
class BagConfig:
    """A bag; the defaults are the paper's."""

    radius: float = 0.1
    """Of the sphere [m]."""
    cut: float = 0.5556
    """Height of the opening above the sphere's centre, in radii. The paper's five bags have 0,
    0.1951, 0.3827, 0.5556 (the one that is used) and 0.7071; the nearest row is taken."""
    mass: float = 1.0
    """Mass of the shell [kg], spread by area."""
    bead_mass: float = 0.01
    """Mass of a bead [kg]."""
    shell_radius: float = 0.004
    """Height of a vertex of the shell that lies on the table [m]."""
    bead_radius: float = 0.0055
    """The same of a bead [m]."""
    visual_radius: float = 0.0075
    """Radius of a bead that is drawn and that a descending tip meets [m]."""
    thickness: float = 0.006
    """Distance at which layers touch [m]; a bead adds 1.5 mm."""
    structural_stiffness: float = 2e3
    """Along rows and columns [N/m]."""
    shear_stiffness: float = 300.0
    """Of the diagonals, which act only in tension [N/m]."""
    bend_stiffness: float = 4.0
    """Between vertices opposite each other across an edge [N/m]."""
    ring_stiffness: float = 220.0
    """Between second neighbours of the ring [N/m]; holds an opened bag open. At 60 the visible
    demonstrator opens 10 to 15 bags in a hundred less."""
    shortest: float = 0.7
    """Hard limit of rows and columns, as a share of the rest length; 0: none."""
    shortest_diagonal: float = 0.5
    """Hard limit of the diagonals; keeps triangles from collapsing."""
    longest: float = 1.06
    """Hard limit of rows and columns, as a share of the rest length."""
    longest_diagonal: float = 1.12
    """Hard limit of the diagonals."""
    exclusion: float = 0.022
    """No self-contact closer than this in the rest shape [m]."""
    edge_contact: float = 0.2
    """Distance at which edges touch, as a share of `thickness`; 0: edges pass each other, and after
    some pulls up to a tenth of them pierce a triangle."""
    grasp_reach: float = 0.015
    """A descending tip takes hold of a vertex this near [m]."""
    friction: float = 1.0
    """Factor on the solver's contact friction for whatever touches the shell."""
    color: Color = YELLOW
    bead_color: Color = BLUE

    def __post_init__(self) -> None:
        stretch = Interval(low=1.0, above_low=True)
        check_fields(
            self,
            dict.fromkeys(
                ("radius", "mass", "shell_radius", "bead_radius", "visual_radius", "thickness",
                 "structural_stiffness", "grasp_reach"), POSITIVE,
            )
            | dict.fromkeys(
                ("bead_mass", "shear_stiffness", "bend_stiffness", "ring_stiffness", "exclusion",
                 "friction"), NOT_NEGATIVE,
            )
            | dict.fromkeys(("longest", "longest_diagonal"), stretch)
            | dict.fromkeys(("shortest", "shortest_diagonal"), BELOW_ONE)
            | {"cut": Interval(low=-0.7, high=0.9), "edge_contact": SHARE},
        )  # fmt: skip

    @property
    def rows(self) -> int:
        """Rows of vertices above the pole; the last one is the opening."""
        return round((math.pi / 2 + math.asin(self.cut)) / _ROW_ANGLE)

    @property
    def opening_radius(self) -> float:
        """Radius of the opening at rest [m]."""
        return self.radius * math.sin(self.rows * _ROW_ANGLE)


@dataclass(frozen=True, eq=False)
class BagShell:
    """A bag's undeformed shape around the sphere's centre, its opening up.

    Attributes:
        vertices: (P, 3) [m]
        faces: vertices of the triangles (T, 3), seen from outside
        ring: vertices around the opening (32,)
        diagonals: edges that halve quadrilaterals (D, 2)
    """

    vertices: np.ndarray
    faces: np.ndarray
    ring: np.ndarray
    diagonals: np.ndarray


@dataclass(frozen=True, eq=False)
class Bag:
    """Where a bag stands in the model; particle numbers are relative to its world.

    Attributes:
        faces: (T, 3), particles at the corners of its triangles
        ring: its beads, around the opening
    """

    config: BagConfig
    particles: range
    springs: range
    triangles: range
    faces: np.ndarray
    ring: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.particles)


def bag_shell(config: BagConfig) -> BagShell:
    """The shell: a pole, then rows of 8, 16 and 32 vertices up to the opening."""
    counts = [_COARSE.get(row, _AROUND) for row in range(1, config.rows + 1)]
    vertices = [[0.0, 0.0, -config.radius]]
    rows: list[list[int]] = []
    for row, count in enumerate(counts, start=1):
        polar = row * _ROW_ANGLE
        rows.append(list(range(len(vertices), len(vertices) + count)))
        for k in range(count):
            turn = 2 * math.pi * k / count
            out = config.radius * math.sin(polar)
            vertices.append(
                [out * math.cos(turn), out * math.sin(turn), -config.radius * math.cos(polar)]
            )
    first = rows[0]
    faces = [[0, first[(k + 1) % len(first)], first[k]] for k in range(len(first))]
    diagonals = []
    for row, (low, high) in enumerate(itertools.pairwise(rows)):
        n = len(low)
        for k in range(n):
            a, b = low[k], low[(k + 1) % n]
            if len(high) == n:
                c, d = high[k], high[(k + 1) % n]
                # by turns, so that the shell has no handedness
                if (k + row) % 2 == 0:
                    faces += [[a, b, d], [a, d, c]]
                    diagonals.append([a, d])
                else:
                    faces += [[a, b, c], [b, d, c]]
                    diagonals.append([b, c])
            else:
                c, middle, d = (high[(2 * k + step) % len(high)] for step in range(3))
                faces += [[a, middle, c], [a, b, middle], [b, d, middle]]
    return BagShell(np.array(vertices), np.array(faces), np.array(rows[-1]), np.array(diagonals))


def add_bag(
    builder: newton.ModelBuilder, config: BagConfig, a_T_b: np.ndarray | None = None
) -> Bag:
    """Add a bag in its undeformed shape, its sphere's centre and opening placed by `a_T_b` (4, 4).

    Raises:
        InputError: the pose is not a rigid one.
    """
    shell = bag_shell(config)
    return _add(builder, config, shell, rigid_pose(a_T_b, "a bag"))


def add_bag_mesh(
    builder: newton.ModelBuilder,
    config: BagConfig,
    surface: Surface,
    a_T_b: np.ndarray | None = None,
    *,
    opening: int | None = None,
) -> Bag:
    """Add a container of any shape: a `surface` (see `add_cloth_mesh`) with an opening.

    Of `config`, radius and cut do not count; all edges are structural; the opening's vertices
    become beads.

    Args:
        opening: a vertex on the boundary loop that is the opening; None where the surface has one
            loop

    Raises:
        InputError: the surface is not one that can be a bag, by name; it has no boundary; it has
            several loops and none is chosen; or `opening` is not on one.
    """
    rest, faces = checked_surface(surface)
    loops = boundary_loops(faces)
    if not loops:
        raise InputError("a bag needs an opening, but the surface is closed")
    if opening is None and len(loops) > 1:
        names = ", ".join(f"{len(loop)} vertices from {loop[0]}" for loop in loops)
        raise InputError(
            f"the surface has {len(loops)} boundary loops ({names}): choose the opening by one of "
            "its vertices"
        )
    chosen = [loop for loop in loops if opening is None or opening in loop]
    if not chosen:
        raise InputError(f"vertex {opening} is not on a boundary of the surface")
    shell = BagShell(rest, faces, np.array(chosen[0]), np.zeros((0, 2), int))
    return _add(builder, config, shell, rigid_pose(a_T_b, "a bag"))


def _add(builder: newton.ModelBuilder, config: BagConfig, shell: BagShell, pose: np.ndarray) -> Bag:
    rest, ring = shell.vertices, shell.ring
    edges, across = edges_and_pairs(shell.faces)
    check_even(rest, edges, "a bag")
    diagonal = np.isin(_key(edges), _key(np.sort(shell.diagonals, axis=1)))
    share = area_share(rest, shell.faces)
    masses = config.mass * share
    masses[ring] += config.bead_mass
    radius = np.full(len(rest), config.shell_radius)
    radius[ring] = config.bead_radius
    skin = np.full(len(rest), config.thickness / 2)
    skin[ring] += config.bead_radius - config.shell_radius
    # a triangle has the skin of its first corner, so that this is not a bead where it can be helped
    faces = np.array([np.roll(f, -int(np.argmin(np.isin(f, ring)))) for f in shell.faces])
    ranges = add_sheet(
        builder,
        rest,
        faces,
        (
            Spring(
                edges[~diagonal],
                config.structural_stiffness,
                shortest=config.shortest,
                longest=config.longest,
            ),
            Spring(
                edges[diagonal],
                config.shear_stiffness,
                SpringMode.AT_MOST,
                shortest=config.shortest_diagonal,
                longest=config.longest_diagonal,
            ),
            Spring(across, config.bend_stiffness),
            Spring(np.column_stack([ring, np.roll(ring, -2)]), config.ring_stiffness),
        ),
        rest @ pose[:3, :3].T + pose[:3, 3],
        masses=masses,
        radius=radius,
        skin=skin,
        edge_gap=config.edge_contact * config.thickness,
        exclusion=config.exclusion,
        friction=config.friction,
        color=config.color,
    )
    first = ranges[0].start
    return Bag(config, *ranges, faces + first, tuple(int(v) + first for v in ring))


def _key(edges: np.ndarray) -> np.ndarray:
    """One number for each pair (E, 2) of vertices."""
    return edges[:, 0] * 1_000_000 + edges[:, 1]
