"""Cables: chains and rings of beads joined by links.

Source: Seita et al., ICRA 2021 (beads, spacing, masses, colours). The original joins cubes with
point-to-point joints; here beads are spheres joined by stiff distance constraints, and folding is
limited by a one-sided minimum distance between a bead and its second neighbour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import NOT_NEGATIVE, POSITIVE, Interval, check_fields
from .attributes import SpringMode, attribute, next_object, register_attributes
from .colors import BLUE, WHITE, YELLOW, Color
from .direct import check_solve, too_heavy, too_stiff

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here


@dataclass(frozen=True, kw_only=True)
class CableConfig:
    """A chain of beads; the defaults are the paper's open cable of 24 beads."""

    beads: int = 24
    closed: bool = False
    """Whether the last bead is linked to the first."""
    spacing: float = 2 * 0.005 * math.sqrt(2)
    """Distance between the centres of neighbours [m]."""
    radius: float = 0.005
    """Contact radius of a bead [m]."""
    visual_radius: float = 0.0075
    """Radius that is drawn and that a descending tip meets [m]."""
    mass: float = 0.1
    """Mass of a bead [kg]."""
    link_stiffness: float = 1e6
    """Stiffness of a link [N/m]; so high that what one iteration a substep leaves over is what a
    dragged link stretches by."""
    fold_limit: float = 1.1
    """Smallest distance between second neighbours, in spacings. Chosen so that the scripted ring
    demonstrator needs as many actions as in the paper."""
    fold_stiffness: float = 1e4
    """Stiffness of the fold limit [N/m]; at 1e3 it stores enough energy to make beads hop."""
    bend_stiffness: float = 0.0
    """Stiffness of the springs that pull a bead to the middle of its neighbours [N/m], so that the
    cable bends like a beam with E I = bend_stiffness * spacing^3 / 4; the paper's bend freely."""
    solve: str | None = None
    """How links and bending are solved: "direct", all of a chain at once, "gauss-seidel", one after
    the other once a substep, which is cheaper, or None: direct where the cable is long or stiff
    (`solved_directly`)."""
    exclusion: float = 2.5
    """Beads closer along the chain than this many spacings do not collide."""
    color: Color = BLUE
    first_color: Color = WHITE
    last_color: Color = YELLOW

    def __post_init__(self) -> None:
        check_fields(
            self,
            dict.fromkeys(
                ("spacing", "radius", "visual_radius", "mass", "link_stiffness"), POSITIVE
            )
            | dict.fromkeys(("fold_stiffness", "bend_stiffness", "exclusion"), NOT_NEGATIVE)
            | {
                "beads": Interval(low=3, whole=True),
                "fold_limit": Interval(low=0.0, high=2.0, below_high=True),
            },
        )
        if self.solve is not None:
            check_solve("CableConfig.solve", self.solve)

    @property
    def length(self) -> float:
        """Length of the straight cable as the paper counts it, beads times spacing [m]."""
        return self.beads * self.spacing

    @property
    def solved_directly(self) -> bool:
        """Whether links are solved together, and bending springs of an open cable."""
        if self.solve is not None:
            return self.solve == "direct"
        return too_heavy(self.beads, self.spacing) or too_stiff(self.bend_stiffness, self.mass)

    def colors(self) -> tuple[Color, ...]:
        """Colour of every bead; only an open cable marks its ends."""
        body = [self.color] * self.beads
        if not self.closed:
            body[0], body[-1] = self.first_color, self.last_color
        return tuple(body)


@dataclass(frozen=True, kw_only=True)
class RingConfig(CableConfig):
    """The paper's closed cable: 32 beads on a circle of radius 0.075 m, all blue."""

    beads: int = 32
    closed: bool = True
    ring_radius: float = 0.075
    """Radius of the circle of bead centres at rest [m]."""
    spacing: float = 2 * 0.075 * math.sin(math.pi / 32)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, {"ring_radius": POSITIVE})


@dataclass(frozen=True)
class Cable:
    """Where a cable stands in the model; particle numbers are relative to its world."""

    config: CableConfig
    particles: range
    springs: range

    @property
    def count(self) -> int:
        """Number of beads."""
        return len(self.particles)


def cable_line(
    config: CableConfig, start: tuple[float, float], end: tuple[float, float]
) -> np.ndarray:
    """Bead positions (beads, 3) [m] on the table, from `start` towards `end`, one spacing apart."""
    direction = np.subtract(end, start)
    length = float(np.hypot(*direction))
    if length == 0:
        raise InputError("cable_line needs two different points")
    steps = np.arange(config.beads)[:, None] * config.spacing
    xy = np.asarray(start) + steps * direction / length
    return np.column_stack([xy, np.full(config.beads, config.radius)])


def cable_ring(config: CableConfig, centre: tuple[float, float]) -> np.ndarray:
    """Bead positions (beads, 3) [m] on the table on the circle that fits the spacing."""
    radius = config.spacing / (2 * math.sin(math.pi / config.beads))
    angle = 2 * np.pi * np.arange(config.beads) / config.beads
    xy = np.asarray(centre) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([xy, np.full(config.beads, config.radius)])


def add_cable(builder: newton.ModelBuilder, config: CableConfig, positions: np.ndarray) -> Cable:
    """Add a cable whose beads start at `positions` (beads, 3) [m].

    Rest lengths come from the config, not from the positions, so a cable may start crumpled.

    Raises:
        InputError: `positions` has another shape or is not finite.
    """
    positions = np.asarray(positions, dtype=float)
    if positions.shape != (config.beads, 3) or not np.isfinite(positions).all():
        raise InputError(
            f"a cable of {config.beads} beads needs finite positions of shape ({config.beads}, 3), "
            f"got {positions.shape}"
        )
    register_attributes(builder)
    number = next_object(builder)
    first_particle, first_spring = builder.particle_count, builder.spring_count
    rest = _rest_shape(config)
    for position, material in zip(positions, rest, strict=True):
        builder.add_particle(
            tuple(position),
            (0.0, 0.0, 0.0),
            config.mass,
            radius=config.radius,
            custom_attributes={
                attribute("particle_object"): number,
                attribute("particle_rest"): tuple(material),
                attribute("particle_exclusion"): config.exclusion * config.spacing,
            },
        )
    offset = float(np.linalg.norm(rest[1] - (rest[0] + rest[2]) / 2))
    link, bend = SpringMode.EQUAL, SpringMode.BEND
    if config.solved_directly:
        # a closed cable keeps round by an offset, which only single springs have
        link, bend = SpringMode.CHAIN, SpringMode.BEND if config.closed else SpringMode.BEAM
    for step, length, stiffness, mode in (
        (1, config.spacing, config.link_stiffness, link),
        (2, config.fold_limit * config.spacing, config.fold_stiffness, SpringMode.AT_LEAST),
        (2, offset, config.bend_stiffness, bend),
    ):
        if stiffness == 0 or (length == 0 and mode == SpringMode.AT_LEAST):
            continue
        starts = range(config.beads if config.closed else config.beads - step)
        together = mode in (SpringMode.CHAIN, SpringMode.BEAM)
        for i in starts if together else _from_both_ends(starts):
            j = (i + step) % config.beads
            builder.add_spring(
                first_particle + i,
                first_particle + j,
                stiffness,
                0.0,
                0.0,
                custom_attributes={
                    attribute("spring_mode"): int(mode),
                    attribute("spring_middle"): first_particle + (i + 1) % config.beads,
                },
            )
            builder.spring_rest_length[-1] = 0.0 if mode == SpringMode.BEAM else length
    return Cable(
        config,
        range(first_particle, builder.particle_count),
        range(first_spring, builder.spring_count),
    )


def _from_both_ends(starts: range) -> list[int]:
    """Order of the constraints along a chain: from both ends by turns, to the middle.

    A sweep carries a pull from either end to the middle, and the processor works on two independent
    chains at once. Solved strictly in order, a lone world takes a third longer; even links first,
    then odd ones, a dragged cable stretches by up to 50 % instead of 10 to 20 %.
    """
    half = len(starts) // 2
    pairs = zip_longest(starts[:half], reversed(starts[half:]))
    return [i for pair in pairs for i in pair if i is not None]


def _rest_shape(config: CableConfig) -> np.ndarray:
    """Straight line or circle of the undeformed cable, (beads, 3) [m], around its own origin."""
    if config.closed:
        return cable_ring(config, (0.0, 0.0)) * [1, 1, 0]
    return cable_line(config, (0.0, 0.0), (1.0, 0.0)) * [1, 1, 0]
