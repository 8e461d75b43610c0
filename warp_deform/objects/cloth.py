"""Fabrics: rectangular sheets of particles joined by springs, with triangles for contact.

Source: Seita et al., ICRA 2021 (10 x 10 vertices, 0.20 m, yellow, corners one cell inwards).
Stretch acts both ways, shear only in tension so that folds stay folded, and no diagonal gets
shorter than half its rest length so that triangles do not collapse in a fold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import BELOW_ONE, NOT_NEGATIVE, POSITIVE, SHARE, Interval, check_fields
from .attributes import SpringMode
from .colors import YELLOW, Color
from .direct import check_solve
from .sheet import Spring, add_sheet

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here

_THICKNESS = 0.006  # [m]
_CELL_SHARE = 0.6  # thickest that layers may be, as a share of the spacing


@dataclass(frozen=True, kw_only=True)
class ClothConfig:
    """A sheet of rows x columns particles, by default as large as the paper's fabric.

    The fabric of the tasks is stiffer, and its edges touch: `tasks.cloth_physics.FABRIC`.
    """

    rows: int = 10
    columns: int = 10
    side: float = 0.2
    """Length of the longer side [m]."""
    mass: float = 0.2
    """Mass of the whole sheet [kg]."""
    radius: float = 0.004
    """Height of a particle that lies on the table [m]."""
    thickness: float | None = None
    """Distance at which layers touch [m]; None: 6 mm, or 0.6 spacings where that is less."""
    structural_stiffness: float = 2e3
    """Along rows and columns, and along the edges of a mesh [N/m]."""
    shear_stiffness: float = 300.0
    """Of the diagonals, which act only in tension [N/m]."""
    bend_stiffness: float = 1e-3
    """Between second neighbours, and across the edges of a mesh [N/m]."""
    shortest: float = 0.7
    longest: float = 1.1
    """Hard limits of rows, columns and a mesh's edges, as shares of the rest length."""
    shortest_diagonal: float = 0.5
    """Hard limit of the diagonals; without it triangles collapse in folds."""
    solve: str = "gauss-seidel"
    """How rows and columns of a sheet are solved: "gauss-seidel", spring after spring once a
    substep, or "direct", each of them as a whole, so that its stiffness does not depend on its
    resolution. A mesh has no rows, and is solved spring after spring."""
    exclusion: float = 1.2
    """No self-contact closer than this in the flat sheet, in spacings. From 1 on a vertex may go
    through the triangles beside its own; below, they are listed all the time where layers are
    nearly as thick as the sheet is fine."""
    edge_contact: float = 0.0
    """Distance at which edges touch, as a share of the layers'; 0: edges pass through each other.
    At 0.2 second folds and crumples pierce less, at 1.4 to 2.2 times the cost."""
    grasp_reach: float = 0.025
    """A descending tip takes hold of a vertex this near [m], as in the original."""
    friction: float = 1.0
    """Factor on the solver's contact friction for whatever touches the sheet's faces."""
    color: Color = YELLOW

    def __post_init__(self) -> None:
        check_fields(
            self,
            dict.fromkeys(("rows", "columns"), Interval(low=2, whole=True))
            | dict.fromkeys(
                ("side", "mass", "radius", "structural_stiffness", "grasp_reach"), POSITIVE
            )
            | dict.fromkeys(
                ("shear_stiffness", "bend_stiffness", "exclusion", "friction"), NOT_NEGATIVE
            )
            | dict.fromkeys(("shortest", "shortest_diagonal"), BELOW_ONE)
            | {"longest": Interval(low=1.0, above_low=True), "edge_contact": SHARE}
            | ({} if self.thickness is None else {"thickness": POSITIVE}),
        )
        check_solve("ClothConfig.solve", self.solve)

    @property
    def spacing(self) -> float:
        """Distance between neighbours along rows and columns [m]."""
        return self.side / (max(self.rows, self.columns) - 1)

    @property
    def inner_corners(self) -> tuple[int, int, int, int]:
        """Vertices one cell inwards of the corners, as the paper's demonstrator takes them."""
        low, high = self.columns + 1, self.columns * (self.rows - 2) + 1
        return low, high, high + self.columns - 3, low + self.columns - 3

    def layer_distance(self, spacing: float) -> float:
        """Distance at which layers of a sheet with such a spacing touch [m].

        Raises:
            InputError: the layers are too thick for the mesh.
        """
        most = _CELL_SHARE * spacing
        if self.thickness is None:
            return min(_THICKNESS, most)
        if self.thickness > most * (1 + 1e-9):
            raise InputError(
                f"ClothConfig.thickness is {self.thickness} m, but layers of a mesh with edges of "
                f"{spacing:.4g} m can be {most:.4g} m thick at most"
            )
        return self.thickness


@dataclass(frozen=True, eq=False)
class Cloth:
    """Where a fabric stands in the model; particle numbers are relative to its world.

    Attributes:
        faces: (T, 3), particles at the corners of its triangles
        corners: particles one cell inwards of the corners of a sheet; empty for a mesh
    """

    config: ClothConfig
    particles: range
    springs: range
    triangles: range
    faces: np.ndarray
    corners: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.particles)


def cloth_sheet(
    config: ClothConfig,
    centre: tuple[float, float],
    *,
    yaw: float = 0.0,
    height: float | None = None,
) -> np.ndarray:
    """Positions (rows * columns, 3) [m] of a flat sheet; number `columns * row + column`.

    Columns run along x and rows along y before the turn by `yaw`.

    Args:
        yaw: turn about the centre [rad]
        height: of the sheet [m]; None lies on the table
    """
    row, column = np.divmod(np.arange(config.rows * config.columns), config.columns)
    x = (column - (config.columns - 1) / 2) * config.spacing
    y = (row - (config.rows - 1) / 2) * config.spacing
    c, s = np.cos(yaw), np.sin(yaw)
    z = np.full(len(x), config.radius if height is None else height)
    return np.column_stack([centre[0] + c * x - s * y, centre[1] + s * x + c * y, z])


def add_cloth(builder: newton.ModelBuilder, config: ClothConfig, positions: np.ndarray) -> Cloth:
    """Add a fabric whose particles start at `positions` (rows * columns, 3) [m].

    Rest lengths come from the config, not from the positions, so a cloth may start crumpled.

    Raises:
        InputError: `positions` has another shape or is not finite, or `thickness` is too large.
    """
    positions = np.asarray(positions, dtype=float)
    count = config.rows * config.columns
    if positions.shape != (count, 3) or not np.isfinite(positions).all():
        raise InputError(
            f"a cloth of {config.rows} x {config.columns} particles needs finite positions of "
            f"shape ({count}, 3), got {positions.shape}"
        )
    number = np.arange(count).reshape(config.rows, config.columns)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.stack([[a, b, d], [a, d, c]], axis=1).transpose(2, 1, 0).reshape(-1, 3)
    direct = config.solve == "direct"
    # of a column solved as a whole, each spring begins where the one before ended
    columns = _ends(number.T, 0, 1) if direct else _ends(number, 1, 0)
    ranges = add_sheet(
        builder,
        cloth_sheet(config, (0.0, 0.0), height=0.0),
        faces,
        (
            Spring(
                np.concatenate([_ends(number, 0, 1), columns]),
                config.structural_stiffness,
                SpringMode.CHAIN if direct else SpringMode.EQUAL,
                shortest=config.shortest,
                longest=config.longest,
            ),
            Spring(
                np.concatenate([np.column_stack([a, d]), np.column_stack([b, c])]),
                config.shear_stiffness,
                SpringMode.AT_MOST,
                shortest=config.shortest_diagonal,
            ),
            Spring(
                np.concatenate([_ends(number, 0, 2), _ends(number, 2, 0)]), config.bend_stiffness
            ),
        ),
        positions,
        masses=np.full(count, config.mass / count),
        radius=config.radius,
        skin=config.layer_distance(config.spacing) / 2,
        edge_gap=config.edge_contact * config.layer_distance(config.spacing),
        exclusion=config.exclusion * config.spacing,
        friction=config.friction,
        color=config.color,
    )
    first = ranges[0].start
    corners = tuple(first + i for i in config.inner_corners)
    return Cloth(config, *ranges, faces + first, corners if min(number.shape) > 2 else ())


def _ends(number: np.ndarray, down: int, right: int) -> np.ndarray:
    """Pairs (S, 2) of vertices so many rows and columns apart."""
    rows, columns = number.shape
    first = number[: rows - down, : columns - right]
    return np.column_stack([first.ravel(), number[down:, right:].ravel()])
