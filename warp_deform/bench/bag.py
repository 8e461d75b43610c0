"""What a simulated second of a falling bag costs, empty or with a cube in it, and one at rest.

Process CPU time, kernels compiled before. Every world starts with another tilt, as the peers do on
the original's mesh of 353 vertices; ours is the bag of the tasks, with edge contact.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import newton
import numpy as np
from scipy.spatial.transform import Rotation

from ..objects.bag import BagConfig, add_bag, bag_shell
from ..objects.box import BoxConfig, BoxPart, add_box
from ..peers.soft_scene import TILT, soft_scene
from ..rollout.rollouts import rollout
from ..solver.solver import SolverFusedXPBD
from ..tasks.bag_physics import BAG_SOLVER
from .timing import Played, time_worlds

__all__ = ["BAG_SCENES", "run_bag"]

BAG_SCENES = ("bag", "bag-cube")
_MOST_WORLDS = 16  # a launch of more would take minutes
_CUBE = BoxConfig(parts=(BoxPart((0.036, 0.036, 0.036)),), mass=0.02, friction=1.5)


def run_bag(*, scene: str, lanes: int = 8, worlds: int = 8, repeats: int = 3) -> dict[str, Any]:
    """Time `scene` (one of `BAG_SCENES`); returns what `bench.run` does, without a peer.

    `ms_per_sim_second` is that of the fall, which ends crumpled; `rest_ms_per_sim_second` that of
    what follows, simulated to the end although everything may be at rest.
    """
    return time_worlds(
        scene,
        partial(_solver, scene),
        partial(_play, scene),
        lanes=lanes,
        worlds=min(worlds, _MOST_WORLDS),
        repeats=repeats,
    )


def _solver(scene: str, worlds: int, lanes: int) -> SolverFusedXPBD:
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    add_bag(one, BagConfig())
    if scene == "bag-cube":
        add_box(one, _CUBE, (0.5, 0.0, 0.1))
    builder.replicate(one, worlds)
    return SolverFusedXPBD(builder.finalize(device="cpu"), BAG_SOLVER, lanes=lanes)


def _play(scene: str, solver: SolverFusedXPBD, seeds: list[int]) -> Played:
    """Fall, each turned as its seed says, then lie."""
    data, shell = solver.data, bag_shell(BagConfig())
    data.reset()
    starts = [soft_scene(scene, seed=seed) for seed in seeds]
    for world, (seed, start) in enumerate(zip(seeds, starts, strict=True)):
        # as `soft_scene` draws it, about the middle of its sphere
        turn = Rotation.from_euler("xyz", np.random.default_rng(seed).normal(0, TILT, 3))
        pole = start.vertices[0] - turn.apply(shell.vertices[0])
        data.lane("particles.x", world)[:] = turn.apply(shell.vertices) + pole
        data.lane("particles.v", world)[:] = 0.0
        if start.cube is not None:
            data.set_bodies(world, np.array([[*start.cube, 0.0, 0.0, 0.0, 1.0]]))
    worlds, fall, lie = range(len(seeds)), starts[0].before, starts[0].after
    begin = time.process_time()
    done = [rollout(solver, worlds, min_seconds=1e3, max_seconds=fall)]
    middle = time.process_time()
    done.append(rollout(solver, worlds, min_seconds=1e3, max_seconds=lie))
    end = time.process_time()
    return Played(
        cpu=middle - begin,
        seconds=fall,
        rest_cpu=end - middle,
        rest_seconds=lie,
        stretch=max(result.watch.stretch for part in done for result in part.values()),
        ends=tuple(data.lane("particles.x", w).copy() for w in worlds),
    )
