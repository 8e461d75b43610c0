"""What a simulated second costs: a lone world, and a world among many in SIMD lanes.

Process CPU time, kernels compiled before. Every start is different: a figure is the median over
starts for the lone world, and of repeated launches for the 64 worlds in lanes. "Falling" is the
time from the start, "rest" the time after two simulated seconds; a peer is timed in the same run,
on the same starts, and ratios compare like with like.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import newton
import numpy as np

from .bench_bag import BAG_SCENES, run_bag
from .bench_cloth import CLOTH_SCENES, run_cloth
from .errors import InputError
from .objects.box import add_box, l_block
from .objects.cable import add_cable
from .peers import PEER_SCENES, PeerScene, check_peer, peer_scene, time_peer
from .solver.solver import SolverFusedXPBD
from .tasks.block import BlockNotarget
from .tasks.cable_physics import CABLE_SOLVER

__all__ = ["SCENES", "run"]

_REST_AFTER = 2.0  # [s], as for the peers
_SOFT_SCENES: dict[str, Callable[..., dict[str, Any]]] = {
    **dict.fromkeys(CLOTH_SCENES, run_cloth),
    **dict.fromkeys(BAG_SCENES, run_bag),
}
"""What times our side of each scene with a play of its own."""
SCENES = (*PEER_SCENES, *_SOFT_SCENES)
"""Names that `run` knows."""
_EDGES = "-edges"  # our edge contact on or off: the peers have one scene for both


def run(
    *,
    scene: str = "cable",
    peer: str | None = None,
    lanes: int = 8,
    worlds: int = 64,
    seconds: float | None = None,
    repeats: int = 5,
) -> dict[str, Any]:
    """Time `scene` ("cable", "heap", "ring", "block", a fabric or a bag), and `peer` beside it.

    The fabrics are those of `bench_cloth`, with at most 16 worlds (4 of 50 rows); their figure is
    the mean over settling, one fold and lying folded, ours and the peer's.

    seconds: simulated time of one measurement [s]; None: 1 s, or the whole play of a fabric or a
    bag, which `seconds` cuts short for a peer alone

    Returns times in process CPU milliseconds per simulated second and world, `ratio` and
    `ratio_lanes` (peer's time over ours, falling; `rest_ratio` at rest) and `same_bits`: whether
    the worlds in lanes ended in the very states they end in alone.

    Raises:
        InputError: no such scene or peer, or the peer is not installed.
        PhysicsError: a guard fired.
    """
    if scene not in SCENES:
        raise InputError(f"no scene {scene!r} to time; choose from {', '.join(SCENES)}")
    if peer is not None:
        check_peer(peer, scene.removesuffix(_EDGES))
    if not ((seconds is None or seconds > 0) and repeats > 0 and worlds > 0):
        raise InputError("seconds, repeats and worlds must be positive")
    if scene in _SOFT_SCENES:
        report = _SOFT_SCENES[scene](scene=scene, lanes=lanes, worlds=worlds, repeats=repeats)
    else:
        length = 1.0 if seconds is None else seconds
        report = _run_rigid(scene, lanes=lanes, worlds=worlds, seconds=length, repeats=repeats)
    if peer is not None:
        theirs = time_peer(peer, scene.removesuffix(_EDGES), seconds=seconds, repeats=repeats)
        report |= theirs.report()
        report |= _ratios(report)
    return report


def _run_rigid(
    scene: str, *, lanes: int, worlds: int, seconds: float, repeats: int
) -> dict[str, Any]:
    """Our own side of a cable or the block."""
    starts = [peer_scene(scene, seed=seed) for seed in range(worlds)]
    begin = time.process_time()
    lone, many = _solver(starts[:1], 1), _solver(starts, lanes)
    for solver in (lone, many):
        solver.run(20)
    start_up = time.process_time() - begin
    alone = [_time(lone, [s], seconds) for s in starts[:repeats]]
    together = [_time(many, starts, seconds) for _ in range(repeats)]
    config = lone.config
    return {
        "scene": scene,
        **_percentiles("ms_per_sim_second", [t[0] for t in alone], 1),
        **_percentiles("rest_ms_per_sim_second", [t[1] for t in alone], 1),
        **_percentiles("ms_per_sim_second_lanes", [t[0] for t in together], worlds),
        **_percentiles("rest_ms_per_sim_second_lanes", [t[1] for t in together], worlds),
        "lanes": lanes,
        "worlds": worlds,
        "dt": config.dt,
        "substeps": round(1 / 60 / config.dt),
        "particles": int(lone.model.particle_count),
        "stretch": max(t[2] for t in alone),
        "same_bits": _same_bits(lone, many, starts, seconds),
        "start_up_seconds": start_up,
    }


def _ratios(report: dict[str, Any]) -> dict[str, float]:
    """The peer's times over ours; a peer cut short has no time at rest."""
    return {
        f"{kind}ratio{many}": report[f"peer_{kind}ms_per_sim_second"]
        / report[f"{kind}ms_per_sim_second{many}"]
        for kind in ("", "rest_")
        for many in ("", "_lanes")
        if f"peer_{kind}ms_per_sim_second" in report
    }


def _solver(starts: list[PeerScene], lanes: int) -> SolverFusedXPBD:
    """One world a start, all of one topology."""
    one = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(one)
    first = starts[0]
    if first.cable is not None:
        add_cable(one, first.cable, first.beads)
    else:
        x, y, z = (float(v) for v in first.block_position)
        add_box(one, l_block(), (x, y, z), yaw=first.block_yaw)
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    builder.replicate(one, len(starts))
    config = CABLE_SOLVER if first.cable is not None else BlockNotarget.solver
    return SolverFusedXPBD(builder.finalize(device="cpu"), config, lanes=lanes)


def _place(solver: SolverFusedXPBD, starts: list[PeerScene]) -> None:
    solver.data.reset()
    for world, start in enumerate(starts):
        if start.cable is not None:
            solver.data.lane("particles.x", world)[:] = start.beads
            solver.data.lane("particles.v", world)[:] = 0.0
        else:
            yaw = start.block_yaw
            quat = [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]
            solver.data.set_bodies(world, np.array([[*start.block_position, *quat]]))


def _time(
    solver: SolverFusedXPBD, starts: list[PeerScene], seconds: float
) -> tuple[float, float, float]:
    """CPU ms per simulated second falling and at rest, and the largest stretch."""
    _place(solver, starts)
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
    stretch = max(v.stretch for values in launches for v in values)
    return 1e3 * falling / seconds, 1e3 * rest / seconds, stretch


def _same_bits(
    lone: SolverFusedXPBD, many: SolverFusedXPBD, starts: list[PeerScene], seconds: float
) -> bool:
    """Whether some of the worlds in lanes match the same worlds alone, bit for bit."""
    steps = round(seconds / lone.config.dt)
    _place(many, starts)
    many.run(steps)
    for world in range(0, len(starts), max(1, len(starts) // 8)):
        _place(lone, [starts[world]])
        lone.run(steps)
        for name in ("particles.x", "particles.v"):
            if not np.array_equal(lone.data.lane(name, 0), many.data.lane(name, world)):
                return False
        for mine, other in zip(lone.data.body_poses(0), many.data.body_poses(world), strict=True):
            if not np.array_equal(mine, other):
                return False
    return True


def _percentiles(name: str, times: list[float], worlds: int) -> dict[str, float]:
    return {
        name: float(np.median(times)) / worlds,
        f"{name}_p95": float(np.percentile(times, 95)) / worlds,
    }
