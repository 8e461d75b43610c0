"""Small scenes for the solver's tests: particles, links, boxes straight from Newton's builder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import newton
import numpy as np

from warp_deform.objects import BoxConfig, add_box
from warp_deform.objects.attributes import SpringMode, attribute
from warp_deform.solver import GuardLimits, SolverConfig, SolverFusedXPBD
from warp_deform.xpbd.packing.topology import WorldTopology

LOOSE = GuardLimits(stretch=1e9, depth=1e9, box_depth=1e9, box_overlap=1e9, clamped_steps=10**9)
IDEAL = SolverConfig(damping=0.0, max_speed=1e3, limits=LOOSE)
"""No air, no speed clamp in reach: what conservation laws and closed forms assume."""
G = 9.81


def ideal(**changes: object) -> SolverConfig:
    """`IDEAL` with some values replaced."""
    return replace(IDEAL, **changes)


def new_builder() -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    return builder


def add_particles(
    builder: newton.ModelBuilder,
    positions: Sequence,
    *,
    velocities: Sequence | None = None,
    masses: float | Sequence[float] = 0.1,
    radius: float = 0.005,
    links: Sequence[tuple[int, int, float]] = (),
    stiffness: float = 1e6,
    colliding: bool = False,
) -> list[int]:
    """Add particles and two-sided links (i, j, rest length [m]); mass 0 pins a particle.

    colliding: each particle is an object of its own, so that any two may touch.
    """
    first = builder.particle_count
    positions = np.asarray(positions, dtype=float)
    velocities = np.zeros_like(positions) if velocities is None else np.asarray(velocities, float)
    masses = np.broadcast_to(masses, len(positions))
    for k, (x, v, m) in enumerate(zip(positions, velocities, masses, strict=True)):
        builder.add_particle(
            tuple(x),
            tuple(v),
            float(m),
            radius=radius,
            custom_attributes={attribute("particle_object"): first + k if colliding else first},
        )
    for i, j, rest in links:
        builder.add_spring(first + i, first + j, stiffness, 0.0, 0.0)
        builder.spring_rest_length[-1] = rest
    return list(range(first, builder.particle_count))


def finalize(
    builder: newton.ModelBuilder,
    config: SolverConfig = IDEAL,
    *,
    gravity: Sequence[float] | float = -G,
    lanes: int = 1,
    precision: str = "float64",
    **options: object,
) -> SolverFusedXPBD:
    """Solver of a finished builder; gravity: along z, or a vector [m/s^2]."""
    model = builder.finalize(device="cpu")
    solver = SolverFusedXPBD(model, config, lanes=lanes, precision=precision, **options)
    vector = np.array([0.0, 0.0, gravity]) if np.isscalar(gravity) else np.asarray(gravity)
    for w in range(solver.data.world_count):
        set_gravity(solver, w, vector)
    return solver


def set_gravity(solver: SolverFusedXPBD, world: int, vector: Sequence[float]) -> None:
    solver.data.per_world("group.gravity", world)[:] = np.asarray(vector)[:, None]


def tilt(angle: float) -> np.ndarray:
    """Gravity (3,) seen from a table that slopes down along +x by `angle` [rad]."""
    return G * np.array([np.sin(angle), 0.0, -np.cos(angle)])


def box_solver(
    *boxes: tuple[BoxConfig, Sequence[float]],
    config: SolverConfig = IDEAL,
    yaw: Sequence[float] | float = 0.0,
    **options: object,
) -> SolverFusedXPBD:
    """Solver of boxes (config, position of the body's frame [m])."""
    builder = new_builder()
    for (box, position), angle in zip(boxes, np.broadcast_to(yaw, len(boxes)), strict=True):
        add_box(builder, box, tuple(position), yaw=float(angle))
    return finalize(builder, config, **options)


def positions(solver: SolverFusedXPBD, world: int = 0) -> np.ndarray:
    """Particle positions (P, 3) of a world, a copy."""
    return solver.data.lane("particles.x", world).copy()


def velocities(solver: SolverFusedXPBD, world: int = 0) -> np.ndarray:
    return solver.data.lane("particles.v", world).copy()


def frames(solver: SolverFusedXPBD, steps: int, every: int = 1) -> np.ndarray:
    """Run a lone world; particle positions (F, P, 3) before every `every`-th substep."""
    solver.run(steps, record_every=every)
    count, total = -(-steps // every), int(solver.data.group_particle[-1])
    recorded = solver.data.views["watch.frame_x"][: count * total]
    return recorded.reshape(count, total, 3, -1)[..., 0].copy()


def body_frames(
    solver: SolverFusedXPBD, steps: int, every: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Run a lone world; centres of mass (F, B, 3) and rotations (F, B, 4) of its bodies."""
    solver.run(steps, record_every=every)
    count, total = -(-steps // every), int(solver.data.group_body[-1])
    x = solver.data.views["watch.frame_body_x"][: count * total].reshape(count, total, 3)
    q = solver.data.views["watch.frame_body_q"][: count * total].reshape(count, total, 4)
    return x.copy(), q.copy()


def spring_energy(top: WorldTopology, x: np.ndarray) -> np.ndarray:
    """Elastic energy (...) [J] of the springs of one world with particles at x (..., P, 3).

    Strain limits store none.
    """
    x = np.asarray(x, dtype=float)
    start, end = x[..., top.spring_ij[:, 0], :], x[..., top.spring_ij[:, 1], :]
    bent = (top.spring_mode == SpringMode.BEND)[:, None]
    way = np.where(bent, x[..., top.spring_middle, :] - (start + end) / 2, start - end)
    stretch = np.linalg.norm(way, axis=-1) - top.spring_length
    acts = np.where(top.spring_mode == SpringMode.AT_LEAST, stretch < 0, True)
    acts &= np.where(top.spring_mode == SpringMode.AT_MOST, stretch > 0, True)
    return (0.5 * stretch**2 / top.spring_compliance * acts).sum(axis=-1)


def energy(solver: SolverFusedXPBD, *, gravity: float = G) -> float:
    """Kinetic, gravitational and elastic energy of a lone world [J]."""
    data, top = solver.data, solver.data.topologies[0]
    total = 0.0
    if data.has_particles:
        x, v, w = positions(solver), velocities(solver), data.lane("particles.w0", 0)
        mass = np.where(w > 0, 1.0 / np.where(w > 0, w, 1.0), 0.0)
        total += mass @ (0.5 * (v**2).sum(1) + gravity * x[:, 2])
        total += float(spring_energy(top, x))
    if data.has_bodies:
        mass = 1.0 / data.views["bodies.w0"]
        v, x = data.views["bodies.v"], data.views["bodies.x"]
        omega = data.views["bodies.omega"]
        total += mass @ (0.5 * (v**2).sum(1) + gravity * x[:, 2])
        total += 0.5 * (omega * angular_momentum(solver)).sum()
    return float(total)


def rotation_matrices(solver: SolverFusedXPBD) -> np.ndarray:
    """Rotations (B, 3, 3) of all bodies."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(solver.data.views["bodies.q"]).as_matrix()


def angular_momentum(solver: SolverFusedXPBD) -> np.ndarray:
    """Spin R I R^T omega (B, 3) of all bodies [kg m^2/s]."""
    turn = rotation_matrices(solver)
    tensor = turn @ solver.data.views["bodies.inertia"] @ turn.transpose(0, 2, 1)
    return np.einsum("bij,bj->bi", tensor, solver.data.views["bodies.omega"])
