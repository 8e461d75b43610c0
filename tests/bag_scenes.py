"""Bags for the solver's tests: drops, pulls, items, and what none of them may do to a shell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from cloth_scenes import edges_of
from scipy.spatial.transform import Rotation
from solver_scenes import new_builder

from warp_deform.objects import Bag, BagConfig, BoxConfig, BoxPart, Push, add_bag, add_box
from warp_deform.objects.bag import BagShell, bag_shell
from warp_deform.rollout import GripPath
from warp_deform.solver import SolverConfig, SolverFusedXPBD

BAG = BagConfig()
SHELL = bag_shell(BAG)
CENTRE = np.array([0.5, 0.0])
BAG_SOLVER = SolverConfig(
    damping=1.0,
    table_friction=0.8,
    contact_friction=0.4,
    recovery=0.1,
    viscosity=30.0,
    dry_friction=2.0,
    sleep_speed=0.006,
    sleep_ramp=20.0,
    margin=0.006,
)
CUBE = BoxConfig(parts=(BoxPart((0.036,) * 3),), mass=0.02, friction=1.5)
PARK = (0.5, 0.35)
"""Where boxes wait [m]."""


def flat_box(a: float) -> BoxConfig:
    """A box of two sides that add up to 7 cm, 3 cm high."""
    return BoxConfig(parts=(BoxPart((a, 0.07 - a, 0.03)),), mass=0.1, friction=1.5)


def bag_solver(
    worlds: int = 1,
    *,
    boxes: Sequence[BoxConfig] = (),
    bags: Sequence[np.ndarray] = (np.eye(4),),
    config: BagConfig = BAG,
    solver: SolverConfig = BAG_SOLVER,
    lanes: int | None = None,
    **options: object,
) -> tuple[SolverFusedXPBD, list[Bag]]:
    """Worlds with bags at poses (4, 4) about the standing one, and boxes parked in a row."""
    one, builder = new_builder(), new_builder()
    stand = np.eye(4)
    stand[:3, 3] = *CENTRE, config.radius + config.shell_radius
    handles = [add_bag(one, config, pose @ stand) for pose in bags]
    for k, box in enumerate(boxes):
        add_box(one, box, (PARK[0] + 0.15 * k, PARK[1], -box.lowest))
    builder.replicate(one, worlds)
    model = builder.finalize(device="cpu")
    return SolverFusedXPBD(model, solver, lanes=lanes, **options), handles


def throw(solver: SolverFusedXPBD, world: int, seed: int, shell: BagShell = SHELL) -> Push:
    """Hang the bag 15 cm high, tilted; the push that folds it on its way down.

    Source: Seita et al., ICRA 2021, appendix (the impulse); it is spread over 0.2 s here.
    """
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("xyz", rng.normal(0, 0.25, 3))
    x = solver.data.lane("particles.x", world)
    x[:] = turn.apply(shell.vertices) + np.append(CENTRE, 0.15)
    solver.data.lane("particles.v", world)[:] = 0.0
    bead = int(shell.ring[rng.integers(32)])
    impulse = np.array([rng.integers(-10, 11), rng.integers(-10, 11), 8.0]) * 12 / 480
    mass = 1.0 / solver.data.lane("particles.w0", world)[bead]
    return Push(bead, impulse / 0.2 / mass, 0.2)


def pull(x: np.ndarray, ring: Sequence[int], radius: float) -> GripPath:
    """Lift the bead that is farthest from an open ring to 5 cm, draw it out, lower it, let go."""
    turn = 2 * np.pi * np.arange(len(ring)) / len(ring)
    way = np.column_stack([np.cos(turn), np.sin(turn)])
    beads = x[np.asarray(ring), :2]
    maps = [np.roll(way, k, axis=0) for k in range(len(ring))]
    best = min(maps, key=lambda m: np.linalg.norm(CENTRE + radius * m - beads, axis=1).sum())
    k = int(np.argmax(np.linalg.norm(CENTRE + radius * best - beads, axis=1)))
    start = x[ring[k]].astype(float)
    end = CENTRE + (radius + 0.02) * best[k]
    lift = max(0.05, start[2])
    knots = [start, [*start[:2], lift], [*end, lift], [*end, BAG.bead_radius]]
    return GripPath(*timed(knots, 0.25), particle=int(ring[k]))


def timed(knots: Sequence, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Times of way-points passed at `speed` [m/s], and the way-points."""
    knots = np.array(knots, dtype=float)
    way = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(way / speed, 0.02))]), knots


def carry(start: np.ndarray, bead: int, way: Sequence[float]) -> GripPath:
    """Lift a bead to 0.40 m, carry it by `way` (2,) [m], lower it until it touches; 0.25 m/s."""
    end = start[:2] + way
    knots = [start, [*start[:2], 0.4], [*end, 0.4], [*end, 0.01]]
    times, knots = timed(knots, 0.25)
    return GripPath(times, knots, particle=bead, lower=(times[2], times[3]))


# -- measures


def collapsed(x: np.ndarray, faces: np.ndarray, rest: np.ndarray = SHELL.vertices) -> np.ndarray:
    """Area of every triangle as a share of that at rest."""

    def twice(p: np.ndarray) -> np.ndarray:
        a, b, c = (p[faces[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1)

    return twice(x.astype(float)) / twice(rest)


def pierced(x: np.ndarray, faces: np.ndarray) -> int:
    """`cloth_scenes.piercing` for many frames: only edges and triangles whose boxes overlap."""
    x = np.asarray(x, dtype=float)
    edges = edges_of(faces)
    ends, corners = x[edges], x[faces]
    near = np.ones((len(edges), len(faces)), bool)
    for axis in range(3):
        near &= ends[..., axis].min(1)[:, None] <= corners[..., axis].max(1)
        near &= ends[..., axis].max(1)[:, None] >= corners[..., axis].min(1)
    e, f = np.nonzero(near)
    apart = ~(edges[e][:, :, None] == faces[f][:, None, :]).any(axis=(1, 2))
    e, f = e[apart], f[apart]
    hit = crossing(x[edges[e, 0]], x[edges[e, 1]], x[faces[f]])
    return len(np.unique(e[np.isfinite(hit)]))


def crossing(start: np.ndarray, end: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Where segments (n, 3) cross triangles (n, 3, 3): share of the way, nan if they do not.

    Source: Moeller, Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997.
    """
    way = end - start
    a = corners[:, 0]
    u, v = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(way, v)
    det = (p * u).sum(1)
    det = np.where(np.abs(det) > 1e-18, det, np.inf)
    t = start - a
    q = np.cross(t, u)
    first, second, along = (t * p).sum(1) / det, (way * q).sum(1) / det, (v * q).sum(1) / det
    inside = (first >= 0) & (second >= 0) & (first + second <= 1) & (along >= 0) & (along <= 1)
    return np.where(inside & np.isfinite(det), along, np.nan)


def winding(points: np.ndarray, x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Share of the sphere around each point (n, 3) that the shell covers, seen from inside.

    It changes continuously as things move, also through the opening, and jumps by 1 where a point
    goes through the fabric. Source: Jacobson et al., "Generalized Winding Numbers", 2013.
    """
    d = x.astype(float)[faces][None] - points.astype(float)[:, None, None, :]
    a, b, c = (d[:, :, k] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(top, bottom).sum(1) / (2 * np.pi)


def corners_of(pose: np.ndarray, size: Sequence[float]) -> np.ndarray:
    """Corners (8, 3) of a box at pose (7,)."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    half = np.asarray(size) / 2
    return pose[:3] + Rotation.from_quat(pose[3:]).apply(signs * half)


def poke(x: np.ndarray, faces: np.ndarray, pose: np.ndarray, size: Sequence[float]) -> float:
    """How far a corner of a box is at most beyond the fabric between it and the centre [m]."""
    x = x.astype(float)
    corners = corners_of(pose.astype(float), size)
    reach = np.linalg.norm(size) / 2
    near = np.flatnonzero(np.linalg.norm(x[faces].mean(1) - pose[:3], axis=1) < reach + 0.03)
    deepest = 0.0
    tri = x[faces[near]]
    if not len(near):
        return 0.0
    normal = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    for corner in corners:
        hit = crossing(
            np.broadcast_to(pose[:3].astype(float), (len(near), 3)),
            np.broadcast_to(corner, (len(near), 3)),
            tri,
        )
        at = np.isfinite(hit)
        if at.any():
            deep = np.abs(((corner - tri[:, 0]) * normal).sum(1))[at]
            deepest = max(deepest, float(deep.max()))
    return deepest


def leaks(points: np.ndarray, frames: np.ndarray, faces: np.ndarray) -> int:
    """How often a point (F, 3) goes through the fabric of `frames` (F, P, 3)."""
    seen = np.array([winding(p[None], x, faces)[0] for p, x in zip(points, frames, strict=True)])
    return int((np.abs(np.diff(seen)) > 0.5).sum())
