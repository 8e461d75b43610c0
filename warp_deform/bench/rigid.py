"""What a simulated second of a cable, a heap, a ring or blocks costs, falling and at rest."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import newton
import numpy as np

from ..objects.box import add_box
from ..objects.cable import add_cable
from ..peers import PeerScene, peer_scene
from ..solver.solver import SolverFusedXPBD
from ..support.quaternion import quat_from_yaw
from ..tasks.block import BlockNotarget
from ..tasks.cable_physics import CABLE_SOLVER
from .timing import Played, time_worlds

__all__ = ["run_rigid"]

_REST_AFTER = 2.0  # [s], as for the peers


def run_rigid(
    *, scene: str, lanes: int, worlds: int, seconds: float, repeats: int
) -> dict[str, Any]:
    """Time one of `PEER_SCENES` for `seconds` [s] from the start, and as long at rest."""
    return time_worlds(
        scene,
        partial(_solver, peer_scene(scene, seed=0)),
        partial(_play, scene, seconds),
        lanes=lanes,
        worlds=worlds,
        repeats=repeats,
    )


def _solver(start: PeerScene, worlds: int, lanes: int) -> SolverFusedXPBD:
    """Worlds of one topology, that of `start`."""
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    if start.cable is not None:
        add_cable(one, start.cable, start.beads)
    else:
        assert start.block is not None
        for (x, y, z), yaw in zip(start.positions.tolist(), start.yaws.tolist(), strict=True):
            add_box(one, start.block, (x, y, z), yaw=yaw)
    builder.replicate(one, worlds)
    config = CABLE_SOLVER if start.cable is not None else BlockNotarget.solver
    return SolverFusedXPBD(builder.finalize(device="cpu"), config, lanes=lanes)


def _place(solver: SolverFusedXPBD, starts: list[PeerScene]) -> None:
    solver.data.reset()
    for world, start in enumerate(starts):
        if start.cable is not None:
            solver.data.lane("particles.x", world)[:] = start.beads
            solver.data.lane("particles.v", world)[:] = 0.0
        else:
            turns = quat_from_yaw(start.yaws)
            solver.data.set_bodies(world, np.column_stack([start.positions, turns]))


def _play(scene: str, seconds: float, solver: SolverFusedXPBD, seeds: list[int]) -> Played:
    """Fall for `seconds`; wait until `_REST_AFTER`; lie for `seconds`."""
    _place(solver, [peer_scene(scene, seed=seed) for seed in seeds])
    steps = round(seconds / solver.config.dt)
    begin = time.process_time()
    launches = [solver.run(steps)]
    falling = time.process_time() - begin
    between = round(_REST_AFTER / solver.config.dt) - steps
    if between > 0:
        launches.append(solver.run(between))
    begin = time.process_time()
    launches.append(solver.run(steps))
    rest = time.process_time() - begin
    for values in launches:
        solver.check(values)  # the time of a scene that blew up says nothing
    return Played(
        cpu=falling,
        seconds=seconds,
        rest_cpu=rest,
        rest_seconds=seconds,
        stretch=max(v.stretch for values in launches for v in values),
        ends=tuple(_state(solver, world) for world in range(len(seeds))),
    )


def _state(solver: SolverFusedXPBD, world: int) -> np.ndarray:
    """Positions, velocities and poses of one world as one row."""
    data = solver.data
    parts = [data.lane(name, world) for name in ("particles.x", "particles.v")]
    return np.concatenate([np.ravel(part) for part in (*parts, *data.body_poses(world))])
