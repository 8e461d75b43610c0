"""What a simulated second of folding a fabric costs: settling, one fold, and lying folded.

Process CPU time, kernels compiled before. Every world folds another way. Sheets of 10, 25 and 50
rows fold without contact between edges and, in scenes named so, with it.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import newton
import numpy as np

from ..errors import InputError
from ..objects.cloth import ClothConfig, add_cloth, cloth_sheet
from ..rollout.rollouts import GripPath, rollout
from ..solver.solver import SolverFusedXPBD
from ..tasks.cloth_physics import CLOTH_SOLVER
from .timing import Played, time_worlds

__all__ = ["CLOTH_SCENES", "run_cloth"]

CLOTH_SCENES = {
    "cloth10": (10, 0.0),
    "cloth25": (25, 0.0),
    "cloth50": (50, 0.0),
    "cloth10-edges": (10, 0.2),
    "cloth25-edges": (25, 0.2),
    "cloth50-edges": (50, 0.2),
}
"""Rows and columns of the sheet of each scene, and `edge_contact`; its side is 0.2 m."""

_MOST_WORLDS = {10: 16, 25: 16, 50: 4}  # by rows: a launch of more would take minutes
_DROP = 0.03  # [m]
_SETTLE, _FOLD, _LIE = 0.8, 1.3, 1.2  # [s]


def run_cloth(*, scene: str, lanes: int = 8, worlds: int = 8, repeats: int = 3) -> dict[str, Any]:
    """Time `scene` (one of `CLOTH_SCENES`); returns what `bench.run` does, without a peer.

    `ms_per_sim_second` is the mean over all of it, `rest_ms_per_sim_second` that of lying folded.

    Raises:
        InputError: no such scene.
    """
    if scene not in CLOTH_SCENES:
        raise InputError(f"no scene {scene!r} to time; choose from {', '.join(CLOTH_SCENES)}")
    rows, edge_contact = CLOTH_SCENES[scene]
    config = ClothConfig(rows=rows, columns=rows, edge_contact=edge_contact)
    return time_worlds(
        scene,
        partial(_solver, config),
        _play,
        lanes=lanes,
        worlds=min(worlds, _MOST_WORLDS[rows]),
        repeats=repeats,
    )


def _solver(config: ClothConfig, worlds: int, lanes: int) -> SolverFusedXPBD:
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    add_cloth(one, config, cloth_sheet(config, (0.5, 0.0), height=_DROP))
    builder.replicate(one, worlds)
    return SolverFusedXPBD(builder.finalize(device="cpu"), CLOTH_SOLVER, lanes=lanes)


def _play(solver: SolverFusedXPBD, seeds: list[int]) -> Played:
    """Settle, fold one corner over, lie folded."""
    data = solver.data
    data.reset()
    worlds = range(len(seeds))
    begin = time.process_time()
    done = [rollout(solver, worlds, min_seconds=_SETTLE, max_seconds=_SETTLE)]
    paths = {}
    for w, seed in enumerate(seeds):
        way = np.random.default_rng(seed).uniform(0.08, 0.16, 2)
        start = data.lane("particles.x", w)[0].astype(float)
        knots = start + np.array([[0, 0, 0], [0, 0, 0.08], [*way, 0.08], [*way, 0.01]])
        paths[w] = GripPath(np.array([0, 0.3, 1.0, _FOLD]), knots, particle=0)
    done.append(rollout(solver, worlds, paths=paths, max_seconds=_FOLD))
    middle = time.process_time()
    done.append(rollout(solver, worlds, min_seconds=_LIE, max_seconds=_LIE))
    end = time.process_time()
    return Played(
        cpu=end - begin,
        seconds=_SETTLE + _FOLD + _LIE,
        rest_cpu=end - middle,
        rest_seconds=_LIE,
        stretch=max(result.watch.stretch for part in done for result in part.values()),
        ends=tuple(data.lane("particles.x", w).copy() for w in worlds),
    )
