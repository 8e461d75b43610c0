"""The fabrics and bags on which this package and its peers are timed, as meshes and motions only.

Source: Seita et al., ICRA 2021, and its released code (meshes, masses, margins, the drop).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ..errors import InputError
from ..objects.bag import BagConfig, bag_shell
from ..objects.cloth import ClothConfig, cloth_sheet

__all__ = ["SoftSceneName"]  # the rest is imported from `warp_deform.peers`

SoftSceneName = Literal[
    "cloth10",
    "cloth25",
    "cloth50",
    "fold10",
    "fold25",
    "crumple10",
    "crumple25",
    "bag",
    "bag-cube",
    "shell-cube",
]
SOFT_SCENES: tuple[str, ...] = get_args(SoftSceneName)

_CENTRE = (0.5, 0.0)
_CLOTH_DROP = 0.03  # [m]
_CLOTH_MASS = 0.5  # [kg]
_SETTLE, _FOLD, _LIE = 0.8, 1.3, 1.2  # [s], as `bench.cloth` plays it
_FOLD_TIMES = (0.0, 0.3, 1.0, _FOLD)  # [s]
_LIFT, _LOW = 0.08, 0.01  # [m]; heights of the corner above where it lay
_LAID, _TURNED, _FELL = 0.3, 1.0, 0.7  # [s]; of a fold along an arc: before, while, after
_WAY, _SKEW = (0.12, 0.16), 0.2  # [m], [rad]; its length, and how far it is off the diagonal
_ARC = 0.9  # height of that arc, as a share of a half circle's
_STAND = 0.02  # [m]; clear height under a sheet that falls on its edge
_ROLL, _LEAN = 0.3, 0.1  # [rad]; how far such a sheet is turned in its plane, and leans
_CURVE = 0.2  # [m]; radius of the arc that it starts as: how a plane buckles is left to rounding
_CRUMPLE = 1.0  # [s]

_BAG_RADIUS = 0.1  # [m]
_BAG_MASS = 1.0  # [kg]
_BAG_MARGIN = 0.003  # [m]
_RING = 32  # vertices on a circle of latitude
_RINGS = 11  # circles of latitude, pi / 16 apart; what is above the last is the opening
_BAG_HEIGHT = 0.15  # [m]; of the sphere's centre
TILT = 0.25  # [rad]; standard deviation of each Euler angle
_BAG_FALL, _BAG_LIE = 1.0, 0.5  # [s]
_CUBE_DEPTH = 0.045  # [m]; of the cube's centre below the sphere's


@dataclass(frozen=True, eq=False)
class SoftScene:
    """Where a fabric or a bag starts, and what is done to it.

    Attributes:
        name: One of `SOFT_SCENES`.
        vertices: Start (V, 3) [m]; edges have their rest lengths.
        triangles: Corners (T, 3), counterclockwise seen from above a sheet or outside a bag.
        edges: Pairs of vertices (E, 2) whose stretch is watched: no quad's diagonal.
        mass: Of the whole mesh in the original [kg]; a bag's beads are extra.
        margin: Collision margin in the original [m].
        ring: Vertices of a bag's opening that carry a bead, in order; empty for a sheet.
        cube: Centre (3,) [m] of the cube within the bag; None where there is none.
        times: When the held vertex passes `knots` [s], from the grasp; empty where none is held.
        knots: Its path, as displacements (K, 3) [m] from where it lies when taken.
        before: Simulated time before the grasp [s]; that of the whole fall where there is none.
        after: Simulated time at rest that ends the play [s].
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    mass: float
    margin: float
    ring: np.ndarray
    cube: np.ndarray | None
    times: np.ndarray
    knots: np.ndarray
    before: float
    after: float

    @property
    def held(self) -> float:
        """How long vertex 0 is held [s]."""
        return float(self.times[-1]) if len(self.times) else 0.0

    @property
    def lengths(self) -> np.ndarray:
        """Rest lengths of the edges (E,) [m]."""
        return self._measured(self.vertices)

    def stretch(self, positions: np.ndarray) -> float:
        """Longest edge over its rest length for vertices at (V, 3) [m]."""
        return float((self._measured(positions) / self.lengths).max())

    def _measured(self, positions: np.ndarray) -> np.ndarray:
        ends = positions[self.edges]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def soft_scene(name: str, *, seed: int = 0) -> SoftScene:
    """A start above the table; `seed` draws the direction of the fold or the tilt of the bag.

    The sheet of `cloth` falls flat by 3 cm, one corner is carried inwards, and it lies folded; that
    of `fold` lies flat, and its corner follows the arc on which it turns about a crease without
    drawing the sheet; that of `crumple` is arched, falls almost upright on a corner and crumples.
    The bag falls with its opening up and crumples: `bag` has the original's mesh, `shell-cube` that
    of the tasks.

    Raises:
        InputError: there is no scene of that name.
    """
    if name not in SOFT_SCENES:
        raise InputError(f"no soft scene is called {name!r}; choose from {', '.join(SOFT_SCENES)}")
    rng = np.random.default_rng(seed)
    if name.startswith("cloth"):
        return _sheet(name, int(name.removeprefix("cloth")), rng)
    if name.startswith("fold"):
        return _turned_sheet(name, int(name.removeprefix("fold")), rng)
    if name.startswith("crumple"):
        return _upright_sheet(name, int(name.removeprefix("crumple")), rng)
    bag = _bag(name, rng)
    return _on_shell(bag) if name.startswith("shell") else bag


def _sheet(name: str, rows: int, rng: np.random.Generator) -> SoftScene:
    config = ClothConfig(rows=rows, columns=rows)
    number = np.arange(rows * rows).reshape(rows, rows)
    way = rng.uniform(0.08, 0.16, 2)  # drawn as `bench.cloth` draws it
    return SoftScene(
        name=name,
        vertices=cloth_sheet(config, _CENTRE, height=_CLOTH_DROP),
        triangles=_triangles(number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]),
        edges=np.concatenate(
            [_pairs(number[:, :-1], number[:, 1:]), _pairs(number[:-1], number[1:])]
        ),
        mass=_CLOTH_MASS,
        margin=config.spacing / 5,
        ring=np.zeros(0, dtype=int),
        cube=None,
        times=np.array(_FOLD_TIMES),
        knots=np.array([[0, 0, 0], [0, 0, _LIFT], [*way, _LIFT], [*way, _LOW]]),
        before=_SETTLE,
        after=_LIE,
    )


def _turned_sheet(name: str, rows: int, rng: np.random.Generator) -> SoftScene:
    """A sheet that lies on the table, and a path of its corner that pulls at nothing else."""
    flat = _sheet(name, rows, rng)
    vertices = flat.vertices.copy()
    vertices[:, 2] = _LOW
    way, heading = rng.uniform(*_WAY), np.pi / 4 + rng.uniform(-_SKEW, _SKEW)
    share = np.linspace(0, 1, 21)
    # without a jerk at either end
    turn = np.pi * share**2 * (3 - 2 * share)
    along = way / 2 * (1 - np.cos(turn))
    height = _ARC * way / 2 * np.sin(turn) + _LOW * turn / np.pi
    return replace(
        flat,
        vertices=vertices,
        times=_TURNED * share,
        knots=np.column_stack([along * np.cos(heading), along * np.sin(heading), height]),
        before=_LAID,
        after=_FELL,
    )


def _upright_sheet(name: str, rows: int, rng: np.random.Generator) -> SoftScene:
    """An arched sheet that stands on a corner, leaning; seeds turn and lean it by other angles."""
    flat = _sheet(name, rows, rng)
    yaw, more = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.3, 2)
    lean = _rotation(np.array([np.pi / 2 - more[0] * _LEAN, 0, 0]))
    turn = _rotation(np.array([0, 0, yaw]))
    roll = _rotation(np.array([0, 0, more[1] * _ROLL]))
    across, along, _ = (flat.vertices - [*_CENTRE, _CLOTH_DROP]).T
    # chords, not arcs, have the edges' lengths
    spacing = flat.lengths[0]
    angle = along / spacing * 2 * np.arcsin(spacing / (2 * _CURVE))
    arched = np.column_stack([across, _CURVE * np.sin(angle), _CURVE * (1 - np.cos(angle))])
    vertices = arched @ (turn @ lean @ roll).T + [*_CENTRE, 0]
    vertices[:, 2] += _STAND - vertices[:, 2].min()
    nothing = np.zeros((0, 3))
    return replace(
        flat, vertices=vertices, times=nothing[:, 0], knots=nothing, before=_CRUMPLE, after=0.0
    )


def _on_shell(bag: SoftScene) -> SoftScene:
    """The same bag on the mesh of the tasks, which is coarser at its pole."""
    shell = bag_shell(BagConfig())
    # both have the pole first, and rows of 32 above
    middle = bag.vertices[-_RING:].mean(axis=0)
    up = middle - bag.vertices[0]
    up /= np.linalg.norm(up)
    ahead = bag.vertices[-_RING] - middle
    ahead /= np.linalg.norm(ahead)
    turn = np.column_stack([ahead, np.cross(up, ahead), up])
    centre = bag.vertices[0] + _BAG_RADIUS * up
    pairs = np.sort(shell.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    sides = {(int(i), int(j)) for i, j in pairs}
    halves = {(int(i), int(j)) for i, j in np.sort(shell.diagonals, axis=1)}
    return replace(
        bag,
        vertices=shell.vertices @ turn.T + centre,
        triangles=shell.faces,
        edges=np.array(sorted(sides - halves)),
        ring=shell.ring,
    )


def _bag(name: str, rng: np.random.Generator) -> SoftScene:
    down = np.pi / 16 * np.arange(1, _RINGS + 1)[:, None]  # angle from the pole at the bottom
    around = 2 * np.pi / _RING * np.arange(_RING)
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), -np.cos(down)
        ),
        axis=-1,
    )
    sphere = _BAG_RADIUS * np.concatenate([[[0, 0, -1]], rings.reshape(-1, 3)])
    number = 1 + np.arange(_RINGS * _RING).reshape(_RINGS, _RING)
    after = np.roll(number, -1, axis=1)
    pole = np.zeros_like(number[0])
    centre = np.array([*_CENTRE, _BAG_HEIGHT])
    no_path = np.zeros((0, 3))
    return SoftScene(
        name=name,
        vertices=sphere @ _rotation(rng.normal(0, TILT, 3)).T + centre,
        triangles=np.concatenate(
            [
                np.column_stack([pole, after[0], number[0]]),
                _triangles(number[:-1], after[:-1], after[1:], number[1:]),
            ]
        ),
        edges=np.concatenate(
            [_pairs(pole, number[0]), _pairs(number, after), _pairs(number[:-1], number[1:])]
        ),
        mass=_BAG_MASS,
        margin=_BAG_MARGIN,
        ring=number[-1],
        cube=centre - [0, 0, _CUBE_DEPTH] if name.endswith("cube") else None,
        times=no_path[:, 0],
        knots=no_path,
        before=_BAG_FALL,
        after=_BAG_LIE,
    )


def _rotation(euler: np.ndarray) -> np.ndarray:
    """Matrix (3, 3) of a turn about x, then y, then z."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(euler), np.cos(euler)
    return (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )


def _pairs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.column_stack([one.ravel(), other.ravel()])


def _triangles(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Two triangles for every quad a, b, c, d."""
    a, b, c, d = (corner.ravel() for corner in (a, b, c, d))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
