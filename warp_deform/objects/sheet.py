"""What all fabrics share: particles, springs and triangles of one sheet in a Newton builder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .attributes import SpringMode, attribute, next_object, register_attributes

if TYPE_CHECKING:
    import newton

__all__ = ["Spring", "add_sheet"]


@dataclass(frozen=True, eq=False)
class Spring:
    """Springs of one kind: which ends (S, 2), how stiff [N/m] and when they act.

    Attributes:
        shortest: hard limit as a share of the rest length, 0: none
        longest: hard limit as a share of the rest length, 0: none
    """

    ends: np.ndarray
    stiffness: float
    mode: SpringMode = SpringMode.EQUAL
    shortest: float = 0.0
    longest: float = 0.0


def add_sheet(
    builder: newton.ModelBuilder,
    rest: np.ndarray,
    faces: np.ndarray,
    springs: tuple[Spring, ...],
    positions: np.ndarray,
    *,
    masses: np.ndarray,
    radius: float | np.ndarray,
    skin: float | np.ndarray,
    edge_gap: float,
    exclusion: float,
    friction: float,
    color: tuple[int, int, int],
) -> tuple[range, range, range]:
    """Add a sheet that is undeformed at `rest` (P, 3) and starts at `positions` (P, 3) [m].

    Args:
        faces: particles at the corners of the triangles (T, 3)
        masses: of the particles (P,) [kg]
        radius: height of a particle on the table [m], one number or (P,)
        skin: half the distance at which layers touch [m], one number or (P,)
        edge_gap: distance at which edges touch [m]; 0: never
        exclusion: no self-contact closer than this in the rest shape [m]

    Returns:
        The ranges of its particles, springs and triangles.
    """
    import warp as wp

    register_attributes(builder)
    number = next_object(builder)
    particles = builder.particle_count
    first_spring, first_triangle = builder.spring_count, builder.tri_count
    radii, skins = (np.broadcast_to(value, len(rest)) for value in (radius, skin))
    for x, mass, height, half in zip(rest, masses, radii, skins, strict=True):
        point = wp.vec3(*(float(v) for v in x))
        builder.add_particle(
            point,
            wp.vec3(0.0, 0.0, 0.0),
            float(mass),
            radius=float(height),
            custom_attributes={
                attribute("particle_object"): number,
                attribute("particle_rest"): point,
                attribute("particle_exclusion"): exclusion,
                attribute("particle_skin"): float(half),
                attribute("particle_edge_gap"): edge_gap,
            },
        )
    # Newton takes the rest shape of a triangle from where its particles are when it is added
    shade = wp.vec3(*(channel / 255 for channel in color))
    for i, j, k in faces:
        builder.add_triangle(
            particles + int(i),
            particles + int(j),
            particles + int(k),
            tri_ke=0.0,
            tri_ka=0.0,
            tri_kd=0.0,
            color=shade,
            custom_attributes={attribute("triangle_friction"): friction},
        )
    for kind, (i, j) in _interleaved(springs):
        builder.add_spring(
            particles + i,
            particles + j,
            kind.stiffness,
            0.0,
            0.0,
            custom_attributes={
                attribute("spring_mode"): int(kind.mode),
                attribute("spring_floor"): kind.shortest,
                attribute("spring_limit"): kind.longest,
            },
        )
    for i, x in enumerate(positions):
        builder.particle_q[particles + i] = wp.vec3(*(float(v) for v in x))
    return (
        range(particles, builder.particle_count),
        range(first_spring, builder.spring_count),
        range(first_triangle, builder.tri_count),
    )


def _interleaved(springs: tuple[Spring, ...]) -> list[tuple[Spring, tuple[int, int]]]:
    """All springs in an order in which neighbours share no particle (greedy colouring).

    The processor can work on several at once; a lone cloth costs a third less than row by row.
    Springs that are solved together come last, in their own order: what others do after them would
    leave them beyond their strain limits.
    """
    used: dict[int, set[int]] = {}
    listed, together = [], list[tuple[Spring, tuple[int, int]]]()
    for kind in springs:
        if kind.stiffness == 0:
            continue
        if kind.mode == SpringMode.CHAIN:
            together += [(kind, (i, j)) for i, j in kind.ends.tolist()]
            continue
        for i, j in kind.ends.tolist():
            mine, other = used.setdefault(i, set()), used.setdefault(j, set())
            color = 0
            while color in mine or color in other:
                color += 1
            mine.add(color)
            other.add(color)
            listed.append((color, kind, (i, j)))
    listed.sort(key=lambda item: item[0])
    return [(kind, ends) for _, kind, ends in listed] + together
