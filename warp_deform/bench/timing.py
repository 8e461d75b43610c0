"""Time a scene alone and among others in SIMD lanes, in process CPU time, kernels compiled before.

A scene module gives a solver for so many worlds, and a play of it from so many starts, one a seed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..solver.solver import SolverFusedXPBD

__all__ = ["Build", "Play", "Played", "time_worlds"]

_WARM_UP = 20  # substeps


@dataclass(frozen=True)
class Played:
    """What one play cost: CPU seconds and simulated seconds of its main part and of its rest."""

    cpu: float
    seconds: float
    rest_cpu: float
    rest_seconds: float
    stretch: float
    """Largest length of a watched spring over its rest length."""
    ends: tuple[np.ndarray, ...]
    """State of each world at the end."""


Build = Callable[[int, int], SolverFusedXPBD]
"""A solver for a number of worlds and a number of lanes."""
Play = Callable[[SolverFusedXPBD, list[int]], Played]
"""Plays one world a seed, from the start of that seed."""


def time_worlds(
    scene: str, build: Build, play: Play, *, lanes: int, worlds: int, repeats: int
) -> dict[str, Any]:
    """Play `repeats` starts alone, then `worlds` starts together, `repeats` times.

    Returns the figures of `bench.run` without a peer: medians and 95th percentiles in CPU ms per
    simulated second and world, and whether a world ended in the same bits alone and in lanes.
    """
    begin = time.process_time()
    lone, many = build(1, 1), build(worlds, lanes)
    for solver in (lone, many):
        solver.run(_WARM_UP)
    start_up = time.process_time() - begin
    alone = [play(lone, [seed]) for seed in range(repeats)]
    together = [play(many, list(range(worlds))) for _ in range(repeats)]
    return {
        "scene": scene,
        **_costs("", alone, 1),
        **_costs("_lanes", together, worlds),
        "lanes": lanes,
        "worlds": worlds,
        "dt": lone.config.dt,
        "substeps": round(1 / 60 / lone.config.dt),
        "particles": int(lone.model.particle_count),
        "stretch": max(played.stretch for played in alone),
        "same_bits": all(
            np.array_equal(played.ends[0], together[0].ends[seed])
            for seed, played in enumerate(alone[:worlds])
        ),
        "start_up_seconds": start_up,
    }


def _costs(suffix: str, plays: list[Played], worlds: int) -> dict[str, float]:
    main = [1e3 * p.cpu / p.seconds / worlds for p in plays]
    rest = [1e3 * p.rest_cpu / p.rest_seconds / worlds for p in plays]
    return {
        f"{kind}ms_per_sim_second{suffix}{part}": float(value)
        for kind, costs in (("", main), ("rest_", rest))
        for part, value in (("", np.median(costs)), ("_p95", np.percentile(costs, 95)))
    }
