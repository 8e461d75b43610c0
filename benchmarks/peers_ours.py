"""This package on the scenes of its peers, one world a start, recorded at the peers' frames."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import newton
import numpy as np

from warp_deform.objects import (
    BagConfig,
    BoxConfig,
    BoxPart,
    ClothConfig,
    add_bag,
    add_box,
    add_cable,
    add_cloth,
)
from warp_deform.peers import PeerScene, SoftScene
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.support.quaternion import quat_from_yaw
from warp_deform.tasks.bag_physics import BAG_SOLVER
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.cable_physics import CABLE_SOLVER
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

__all__ = ["OursSettings", "play_ours"]

FRAME_RATE = 60
CUBE = BoxConfig(parts=(BoxPart((0.036, 0.036, 0.036)),), mass=0.02, friction=1.5)
EDGE_CONTACT = 0.2
LONG = 1e3  # [s]; a world that must not end before its time is up


@dataclass(frozen=True, kw_only=True)
class OursSettings:
    """What is swept of this package: all else is as its tasks have it."""

    hz: int = 1200
    """Substeps per second."""
    lanes: int = 1
    precision: str = "float32"


def play_ours(
    starts: list[PeerScene] | list[SoftScene], settings: OursSettings, *, record: bool
) -> tuple[np.ndarray, float]:
    """Positions (starts, frames, n, 3) [m], empty unless recorded; CPU ms a second and world.

    Worlds are side by side if there are lanes, and one after the other if there are none.
    """
    if settings.lanes == 1:
        solver = _solver(starts[0], 1, settings)
        plays = [_play(solver, [start], record) for start in starts]
    else:
        plays = [_play(_solver(starts[0], len(starts), settings), starts, record)]
    tracks = np.concatenate([tracks for tracks, _, _ in plays])
    seconds = sum(seconds for _, seconds, _ in plays)
    return tracks, 1e3 * sum(cpu for _, _, cpu in plays) / seconds


def _solver(start: Any, worlds: int, settings: OursSettings) -> SolverFusedXPBD:
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    config = _add(one, start)
    builder.replicate(one, worlds)
    solver = SolverFusedXPBD(
        builder.finalize(device="cpu"),
        replace(config, dt=1 / settings.hz),
        lanes=settings.lanes,
        precision=settings.precision,
    )
    solver.run(20)
    return solver


def _add(builder: newton.ModelBuilder, start: Any) -> SolverConfig:
    """Put the scene into `builder`; returns the solver's configuration of its tasks."""
    if isinstance(start, PeerScene):
        if start.cable is not None:
            add_cable(builder, start.cable, start.beads)
            return CABLE_SOLVER
        assert start.block is not None
        for (x, y, z), yaw in zip(start.positions.tolist(), start.yaws.tolist(), strict=True):
            add_box(builder, start.block, (x, y, z), yaw=yaw)
        return BlockNotarget.solver
    if len(start.ring):
        add_bag(builder, BagConfig())
        add_box(builder, CUBE, (0.5, 0.0, 0.1))
        return BAG_SOLVER
    rows = round(len(start.vertices) ** 0.5)
    add_cloth(
        builder, ClothConfig(rows=rows, columns=rows, edge_contact=EDGE_CONTACT), start.vertices
    )
    return FABRIC_SOLVER


def _play(
    solver: SolverFusedXPBD, starts: list[Any], record: bool
) -> tuple[np.ndarray, float, float]:
    """Tracks (worlds, frames, n, 3), simulated seconds of all worlds, and CPU seconds."""
    _place(solver, starts)
    phases: list[tuple[float, bool]] = [(1.0, False)]
    if isinstance(starts[0], SoftScene):
        first = starts[0]
        phases = [(first.before, False), (first.held, True), (first.after, False)]
    worlds = range(len(starts))
    frames: list[list[np.ndarray]] = [[] for _ in starts]
    spent = 0.0
    for seconds, held in phases:
        if not seconds:
            continue
        paths = {}
        if held:
            for w, start in enumerate(starts):
                corner = _positions(solver, w)[0].astype(float)
                paths[w] = GripPath(start.times, start.knots + corner, particle=0)
        begin = time.process_time()
        done = rollout(
            solver,
            worlds,
            paths=paths,
            min_seconds=0.0 if held else LONG,
            max_seconds=seconds,
            record=1 / FRAME_RATE if record else 0.0,
        )
        spent += time.process_time() - begin
        for w in worlds:
            seen = done[w].frames
            if seen is not None:
                whole = seen.particle_q if seen.particle_q.shape[1] else seen.body_q[:, :, :3]
                frames[w] += [*whole]
    if not record:
        tracks = np.zeros((len(starts), 0, 0, 3))
    else:
        tracks = np.array([[*frames[w][1:], _positions(solver, w)] for w in worlds], dtype=float)
    return tracks, len(starts) * sum(seconds for seconds, _ in phases), spent


def _place(solver: SolverFusedXPBD, starts: list[Any]) -> None:
    data = solver.data
    data.reset()
    for w, start in enumerate(starts):
        if isinstance(start, PeerScene) and start.cable is None:
            turns = quat_from_yaw(start.yaws)
            data.set_bodies(w, np.column_stack([start.positions, turns]))
            continue
        particles = start.beads if isinstance(start, PeerScene) else start.vertices
        data.lane("particles.x", w)[:] = particles
        data.lane("particles.v", w)[:] = 0.0
        if isinstance(start, SoftScene) and start.cube is not None:
            data.set_bodies(w, np.array([[*start.cube, 0.0, 0.0, 0.0, 1.0]]))


def _positions(solver: SolverFusedXPBD, world: int) -> np.ndarray:
    """Of the particles, or of the bodies where there are none (n, 3) [m]."""
    if solver.model.particle_count:
        return solver.particle_q(world)
    return solver.body_q(world)[:, :3]
