"""Reads a `newton.Model` into topologies: the constraint lists that worlds share.

Two worlds have the same topology when their springs, particles, bodies and shapes are the same
apart from where they start and how heavy they are; such worlds can share SIMD lanes.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import newton
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import eigsh

from ...errors import InputError
from ...objects.attributes import NAMESPACE, SpringMode
from ..springs.tether import NO_TETHER
from .sheets import Sheets

__all__ = ["WorldTopology", "greatest_loss", "pieces", "read_worlds", "runs", "tethers"]

_RUN_OF_A_PASS = 10
_BENDING = (int(SpringMode.BEND), int(SpringMode.BEAM))


@dataclass(frozen=True, eq=False)
class WorldTopology:
    """One world as the solver sees it; all indices are local to the world.

    The fields of single particles of sheets are empty where a world has no triangles.

    Attributes:
        spring_ij: (S, 2), particles at the ends
        spring_length: (S,) [m]
        spring_compliance: (S,) [m/N]
        spring_limit: (S,) [m]
        spring_floor: (S,) [m]
        spring_mode: (S,), see `SpringMode`
        spring_watched: (S,), two-sided and not a soft one of a fabric; the stretch guard looks at
            these
        spring_middle: (S,), third particle of a bending spring, else -1
        spring_run: (S,), springs that are solved together from this one on; 0: amid them
        pair_ij: (C, 2), particles that may collide
        pair_distance: (C,), where they touch [m]
        particle_radius: (P,) [m]
        shape_body: (K,), the body that a box belongs to
        shape_center: (K, 3), relative to the body's centre of mass [m]
        shape_rotation: (K, 4), xyzw
        shape_half: (K, 3) [m]
        shape_friction: (K,)
        body_com: (B, 3), centre of mass in the body's frame [m]
        sheet_triangle: (T, 3), particles at the corners
        sheet_friction: (T,)
        sheet_skin: (P,) [m]
        sheet_rest: (P, 3), place in the rest shape [m]
        sheet_owner: (P,), the object that a particle belongs to
        sheet_exclusion: (P,), no contact closer than this in the rest shape [m]
        sheet_edge: (E, 2), edges that meet each other
        sheet_edge_gap: (P,), where they touch [m]
        sheet_cell: least side of a cell of their contact list [m]
    """

    spring_ij: np.ndarray
    spring_length: np.ndarray
    spring_compliance: np.ndarray
    spring_limit: np.ndarray
    spring_floor: np.ndarray
    spring_mode: np.ndarray
    spring_watched: np.ndarray
    spring_middle: np.ndarray
    spring_run: np.ndarray
    pair_ij: np.ndarray
    pair_distance: np.ndarray
    particle_radius: np.ndarray
    shape_body: np.ndarray
    shape_center: np.ndarray
    shape_rotation: np.ndarray
    shape_half: np.ndarray
    shape_friction: np.ndarray
    body_com: np.ndarray
    sheet_triangle: np.ndarray
    sheet_friction: np.ndarray
    sheet_skin: np.ndarray
    sheet_rest: np.ndarray
    sheet_owner: np.ndarray
    sheet_exclusion: np.ndarray
    sheet_edge: np.ndarray
    sheet_edge_gap: np.ndarray
    sheet_cell: float

    @property
    def particle_count(self) -> int:
        return len(self.particle_radius)

    @property
    def passes(self) -> int:
        """How often its springs are solved in a substep.

        Runs that cross do not know of each other: once for every 10 springs of the longest of them.
        """
        first = np.flatnonzero(self.spring_run > 1)
        count = self.spring_run[first]
        spans = [self.spring_ij[a : a + n] for a, n in zip(first, count, strict=True)]
        met = np.bincount(
            np.concatenate([np.unique(s) for s in spans] or [np.zeros(0, int)]),
            minlength=self.particle_count,
        )
        crossing = [n for s, n in zip(spans, count, strict=True) if (met[s] > 1).any()]
        return -(-max(crossing, default=1) // _RUN_OF_A_PASS)

    @property
    def body_count(self) -> int:
        return len(self.body_com)

    def key(self) -> bytes:
        """Equal for worlds that can share lanes."""
        return b"|".join(np.ascontiguousarray(v).tobytes() for v in vars(self).values())


@functools.lru_cache(maxsize=256)
def tethers(topology: WorldTopology, held: int) -> np.ndarray:
    """Longest distance (P,) [m] of every particle from the particle `held` of a fabric.

    It is the shortest way along springs at their strain limits; particles that are not joined to it
    by such springs, and all where a cable or nothing is held, have none (`NO_TETHER`).
    """
    limited = (topology.spring_limit > 0) & (topology.spring_mode != int(SpringMode.AT_LEAST))
    longest = np.full(topology.particle_count, NO_TETHER)
    if limited.any():
        i, j = topology.spring_ij[limited].T
        size = (topology.particle_count, topology.particle_count)
        ways = csr_array((topology.spring_limit[limited], (i, j)), shape=size)
        reach = dijkstra(ways, directed=False, indices=held)
        joined = np.isfinite(reach)
        longest[joined] = reach[joined]
    longest.flags.writeable = False  # callers share it
    return longest


def runs(ij: np.ndarray, middle: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """Numbers (S,) of springs that are solved together, at the first of them; 0 at the others.

    A CHAIN spring goes on where the one before ended, a BEAM spring bends the next particle. A run
    ends before a particle that it has met, so the spring that closes a ring is solved by itself.
    """
    out = np.ones(len(ij), int)
    first, met = 0, set[int]()
    for s, (i, j) in enumerate(ij.tolist()):
        goes_on = s > first and mode[s] == mode[s - 1] and j not in met
        if mode[s] == int(SpringMode.CHAIN):
            goes_on = goes_on and i == ij[s - 1, 1]
        elif mode[s] == int(SpringMode.BEAM):
            goes_on = goes_on and (i, middle[s]) == (middle[s - 1], ij[s - 1, 1])
        else:
            goes_on = False
        if goes_on:
            out[first], out[s] = out[first] + 1, 0
        else:
            first, met = s, {i, int(middle[s])}
        met.add(j)
    return out


def pieces(topology: WorldTopology) -> list[np.ndarray]:
    """Pairs of neighbours (N, 2) in each piece of fabric: the ends of the springs that join it."""
    ij = topology.spring_ij[np.isin(topology.spring_ij, topology.sheet_triangle).all(axis=1)]
    size = (topology.particle_count, topology.particle_count)
    graph = csr_array((np.ones(len(ij)), (ij[:, 0], ij[:, 1])), shape=size)
    piece = connected_components(graph, directed=False)[1][ij[:, 0]]
    return [ij[piece == p] for p in np.unique(piece)]


def greatest_loss(pairs: np.ndarray, w: np.ndarray) -> float:
    """Largest share of their relative velocity that neighbours (N, 2) may lose at once.

    With more, the fastest change of sign from neighbour to neighbour would grow. All lose by the
    velocities before, so that v' = v - share W A v with the inverse masses w (P,) of the piece's
    particles and the Laplacian A of the pairs, weighted by their reduced masses.
    """
    i, j = pairs.T
    mass = 1.0 / np.maximum(w[i] + w[j], 1e-9)
    ends = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([mass, mass, -mass, -mass]) * np.sqrt(w[ends[0]] * w[ends[1]])
    if not values.any():
        return math.inf
    matrix = csr_array((values, ends), shape=(len(w), len(w)))
    start = np.cos(np.arange(len(w)))
    return 2.0 / float(eigsh(matrix, 1, which="LA", v0=start, return_eigenvectors=False)[0])


def _slices(worlds: np.ndarray, count: int, what: str) -> list[np.ndarray]:
    """Element numbers of every world; only a lone world may have global elements (-1)."""
    if count == 1:
        return [np.arange(len(worlds))]
    if (worlds < 0).any():
        raise InputError(f"{what} outside every world are not supported next to replicated worlds")
    return [np.flatnonzero(worlds == w) for w in range(count)]


def read_worlds(
    model: newton.Model,
) -> tuple[list[WorldTopology], list[np.ndarray], list[np.ndarray]]:
    """Topology, particle numbers and body numbers of every world of `model`.

    Raises:
        InputError: the model holds something that this solver does not simulate.
    """
    if not hasattr(model, NAMESPACE):
        raise InputError(
            "the model lacks warp_deform's attributes: build it with add_cable, add_box, ... or "
            "call SolverFusedXPBD.register_custom_attributes(builder) first"
        )
    _refuse_unsupported(model)
    ours = getattr(model, NAMESPACE)
    count = max(1, model.world_count)
    radius = model.particle_radius.numpy() if model.particle_count else np.zeros(0)
    world = model.particle_world.numpy() if model.particle_count else np.zeros(0, int)
    particles = _slices(world, count, "particles")
    bodies = _slices(
        model.body_world.numpy() if model.body_count else np.zeros(0, int), count, "bodies"
    )
    springs = _Springs(model, ours)
    shapes = _Shapes(model)
    sheets = Sheets(model)
    topologies = []
    for ids, body_ids in zip(particles, bodies, strict=True):
        local = np.full(model.particle_count + 1, -1)
        local[ids] = np.arange(len(ids))
        sheet = sheets.of(ids, local)
        fabric = sheet["sheet_triangle"]
        pair_ij, pair_distance = _pairs(ids, ours, radius, fabric) if len(ids) else _no_pairs()
        topologies.append(
            WorldTopology(
                **springs.of(ids, local),
                pair_ij=pair_ij,
                pair_distance=pair_distance,
                particle_radius=radius[ids],
                **shapes.of(body_ids),
                body_com=model.body_com.numpy()[body_ids] if len(body_ids) else np.zeros((0, 3)),
                **sheet,
            )
        )
    return topologies, particles, bodies


def _refuse_unsupported(model: newton.Model) -> None:
    """Raise for content that would otherwise be left out without a word."""
    for what, amount in (
        ("tetrahedra", model.tet_count),
        ("bending edges", model.edge_count),
        ("muscles", model.muscle_count),
        ("tendons", model.tendon_count),
        ("particles attached to bodies", model.attachment_particle_body_count),
    ):
        if amount:
            raise InputError(f"SolverFusedXPBD does not simulate {what} ({amount} in the model)")
    if model.shape_count:
        for kind in set(model.shape_type.numpy().tolist()) - {int(newton.GeoType.BOX)}:
            name = newton.GeoType(kind).name.lower()
            hint = "; the table z = 0 is built in" if kind == newton.GeoType.PLANE else ""
            raise InputError(f"SolverFusedXPBD simulates boxes only, the model has a {name}{hint}")
        if (model.shape_body.numpy() < 0).any():
            raise InputError(
                "SolverFusedXPBD has no fixed boxes: give the box a body (of mass 0 to fix it)"
            )
    if model.joint_count:
        for kind in set(model.joint_type.numpy().tolist()) - {int(newton.JointType.FREE)}:
            name = newton.JointType(kind).name.lower()
            raise InputError(f"SolverFusedXPBD has no joints, the model has a {name} joint")
    if model.body_count and (model.body_flags.numpy() & int(newton.BodyFlags.KINEMATIC)).any():
        raise InputError("SolverFusedXPBD has no kinematic bodies: hold the body with a grip path")
    if model.spring_count:
        mode = getattr(model, NAMESPACE).spring_mode.numpy()
        bent = np.isin(mode, _BENDING)
        unknown = mode[~np.isin(mode, list(SpringMode))]
        if len(unknown):
            modes = ", ".join(f"{each.value} {each.name}" for each in SpringMode)
            raise InputError(f"there is no spring_mode {unknown[0]}; there are: {modes}")
        if model.spring_rest_length.numpy()[mode == int(SpringMode.BEAM)].any():
            raise InputError("a BEAM spring needs rest length 0: only BEND springs have another")
        for what, values in (
            ("rest length", model.spring_rest_length.numpy()[~bent]),
            ("stiffness", model.spring_stiffness.numpy()),
        ):
            if not (values > 0).all():
                raise InputError(f"every spring needs a positive {what}, got {values.min()}")
        if model.spring_damping.numpy().any():
            raise InputError("SolverFusedXPBD has no spring damping: set it to 0")


class _Springs:
    def __init__(self, model: newton.Model, ours: object) -> None:
        self.count = model.spring_count
        if self.count:
            self.ij = model.spring_indices.numpy().reshape(-1, 2)
            self.length = model.spring_rest_length.numpy()
            self.compliance = 1.0 / model.spring_stiffness.numpy()
            self.limit = ours.spring_limit.numpy() * self.length  # type: ignore[attr-defined]
            self.floor = ours.spring_floor.numpy() * self.length  # type: ignore[attr-defined]
            self.mode = ours.spring_mode.numpy()  # type: ignore[attr-defined]
            middle = ours.spring_middle.numpy()  # type: ignore[attr-defined]
            # a fabric's edges have a strain limit; its bending pairs may lengthen as it flattens
            corners = model.tri_indices.numpy() if model.tri_count else np.zeros(0, int)
            edge = (self.limit > 0) | ~np.isin(self.ij, corners).any(axis=1)
            self.watched = edge & np.isin(self.mode, (SpringMode.EQUAL, SpringMode.CHAIN))
            self.middle = np.where(np.isin(self.mode, _BENDING), middle, -1)

    def of(self, ids: np.ndarray, local: np.ndarray) -> dict[str, np.ndarray]:
        if not self.count:
            empty = np.zeros(0)
            return {
                "spring_ij": np.zeros((0, 2), int),
                "spring_length": empty,
                "spring_compliance": empty,
                "spring_limit": empty,
                "spring_floor": empty,
                "spring_mode": empty.astype(int),
                "spring_watched": empty.astype(int),
                "spring_middle": empty.astype(int),
                "spring_run": empty.astype(int),
            }
        mine = np.isin(self.ij[:, 0], ids)
        bent = mine & np.isin(self.mode, _BENDING)
        if not np.isin(self.middle[bent], ids).all():
            raise InputError("a BEND spring needs spring_middle, a particle of its own world")
        return {
            "spring_ij": local[self.ij[mine]],
            "spring_length": self.length[mine],
            "spring_compliance": self.compliance[mine],
            "spring_limit": self.limit[mine],
            "spring_floor": self.floor[mine],
            "spring_mode": self.mode[mine],
            "spring_watched": self.watched[mine],
            "spring_middle": local[self.middle[mine]],
            "spring_run": runs(self.ij[mine], self.middle[mine], self.mode[mine]),
        }


class _Shapes:
    def __init__(self, model: newton.Model) -> None:
        self.model = model
        self.body = model.shape_body.numpy() if model.shape_count else np.zeros(0, int)

    def of(self, bodies: np.ndarray) -> dict[str, np.ndarray]:
        rows = np.flatnonzero(np.isin(self.body, bodies))
        if not len(rows):
            return {
                "shape_body": np.zeros(0, int),
                "shape_center": np.zeros((0, 3)),
                "shape_rotation": np.zeros((0, 4)),
                "shape_half": np.zeros((0, 3)),
                "shape_friction": np.zeros(0),
            }
        local = {b: i for i, b in enumerate(bodies)}
        body = np.array([local[b] for b in self.body[rows]])
        transform = self.model.shape_transform.numpy()[rows]
        com = self.model.body_com.numpy()[self.body[rows]]
        return {
            "shape_body": body,
            "shape_center": transform[:, :3] - com,
            "shape_rotation": transform[:, 3:],
            "shape_half": self.model.shape_scale.numpy()[rows],
            "shape_friction": self.model.shape_material_mu.numpy()[rows],
        }


def _no_pairs() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((0, 2), int), np.zeros(0)


def _pairs(
    ids: np.ndarray, ours: object, radius: np.ndarray, fabric: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j that may collide: of different objects, or far enough apart in the rest shape.

    Corners of the triangles `fabric` are left out: particles meet the triangles instead.
    """
    free = np.ones(len(ids), bool)
    free[fabric.ravel()] = False
    number = np.flatnonzero(free)
    i, j = (number[side] for side in np.triu_indices(len(number), 1))
    owner = ours.particle_object.numpy()[ids]  # type: ignore[attr-defined]
    rest = ours.particle_rest.numpy()[ids]  # type: ignore[attr-defined]
    exclusion = ours.particle_exclusion.numpy()[ids]  # type: ignore[attr-defined]
    apart = np.linalg.norm(rest[i] - rest[j], axis=1) > np.minimum(exclusion[i], exclusion[j])
    keep = (owner[i] != owner[j]) | apart
    pairs = np.column_stack([i, j])[keep]
    return pairs, radius[ids][pairs].sum(axis=1)
