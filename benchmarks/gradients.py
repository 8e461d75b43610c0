"""What derivatives cost: taped forward and backward beside the plain forward, in the same run.

    python benchmarks/gradients.py [--scenes cable heap cloth10 bag bag-cube block] [--json]

Process CPU milliseconds per simulated second and world, 8 worlds in 8 lanes, float32, kernels
compiled before, median over repeats; MB (10^6 bytes) of tape and checkpoints at their peak
likewise. `full` keeps every tape, `replay` checkpoints and one tape, and its backward runs every
segment again.
The worlds start as `warp-deform bench` starts them and run without a grip: beads crumpled (cable)
or stacked (heap), a sheet crumpled above the table, a bag dropped, alone or with the two boxes of
bag-items-2 in it (bag-cube), the L-block dropped while it slides and turns.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import newton
import numpy as np

from warp_deform.objects import (
    BagConfig,
    BoxConfig,
    BoxPart,
    CableConfig,
    ClothConfig,
    add_bag,
    add_box,
    add_cable,
    add_cloth,
    bag_shell,
    cable_line,
    cloth_sheet,
    l_block,
)
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import DifferentiableRollout, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.bag_physics import BAG_SOLVER
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER

LANES = 8
CABLE, CLOTH, BAG = CableConfig(), ClothConfig(), BagConfig()
BOX = BoxConfig(parts=(BoxPart((0.035, 0.035, 0.03)),), mass=0.1, friction=1.5)
BLOCK = l_block()
MEMORY = 2**31


@dataclass(frozen=True)
class Scene:
    """Objects, physics, simulated time [s], and where particles (P, 3) and the frames (B, 7) and
    twists (B, 6) of bodies start, drawn.
    """

    add: Callable[[newton.ModelBuilder], object]
    solver: SolverConfig
    seconds: float
    start: Callable[[np.random.Generator], np.ndarray]
    bodies: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]] | None = None


@dataclass(frozen=True)
class Cost:
    """Times in CPU ms, memory in MB, per simulated second and world; ratios to the plain run."""

    scene: str
    storage: str
    plain_ms: float
    taped_ms: float
    backward_ms: float
    taped_ratio: float
    backward_ratio: float
    memory_mb: float


def _crumpled(rng: np.random.Generator) -> np.ndarray:
    line = cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))
    return np.add(line, [0, 0, 0.01]) + rng.normal(0, 4e-3, line.shape)


def _heap(rng: np.random.Generator) -> np.ndarray:
    xy = 0.5 + rng.normal(0, 4e-3, (CABLE.beads, 2)) - [0, 0.5]
    return np.column_stack([xy, 0.02 + 0.006 * np.arange(CABLE.beads)])


def _sheet(rng: np.random.Generator) -> np.ndarray:
    flat = cloth_sheet(CLOTH, (0.5, 0.0), height=0.05)
    return flat + rng.normal(0, 2e-3, flat.shape)


def _bag(rng: np.random.Generator) -> np.ndarray:
    vertices = bag_shell(BAG).vertices
    lifted = vertices - [0, 0, vertices[:, 2].min() - 0.03] + [0.5, 0, 0]
    return lifted + rng.normal(0, 1e-4, vertices.shape)


def _no_particles(_rng: np.random.Generator) -> np.ndarray:
    return np.zeros((0, 3))


def _boxes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One above the other, in the bag and about to land on its bottom."""
    poses = np.tile([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (2, 1))
    poses[:, :2] += rng.normal(0, 2e-3, (2, 2))
    poses[:, 2] = 0.03 + 0.03 + np.array([0.0, 0.035])
    return poses, np.zeros((2, 6))


def _sliding(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    poses = np.array([[0.5, 0.0, 0.005 - BLOCK.lowest, 0.0, 0.0, 0.0, 1.0]])
    return poses, rng.normal(0, 1, (1, 6)) * [0.3, 0.3, 0.0, 0.5, 0.5, 3.0]


def _add_bag_and_boxes(builder: newton.ModelBuilder) -> None:
    add_bag(builder, BAG)
    for _ in range(2):
        add_box(builder, BOX, (0.5, 0.4, -BOX.lowest))


SCENES = {
    "cable": Scene(
        lambda b: add_cable(b, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))),
        SolverConfig(),
        1.0,
        _crumpled,
    ),
    "heap": Scene(
        lambda b: add_cable(b, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))),
        SolverConfig(),
        1.0,
        _heap,
    ),
    "cloth10": Scene(
        lambda b: add_cloth(b, CLOTH, cloth_sheet(CLOTH, (0.5, 0.0))), CLOTH_SOLVER, 0.5, _sheet
    ),
    "bag": Scene(lambda b: add_bag(b, BAG), BAG_SOLVER, 0.25, _bag),
    "bag-cube": Scene(_add_bag_and_boxes, BAG_SOLVER, 0.25, _bag, _boxes),
    "block": Scene(
        lambda b: add_box(b, BLOCK, (0.5, 0.0, -BLOCK.lowest)),
        SolverConfig(table_friction=1.0, contact_friction=1.0),
        1.0,
        _no_particles,
        _sliding,
    ),
}


def measure(name: str, repeats: int) -> list[Cost]:
    """Costs of one scene with both storages; every repeat starts elsewhere, all runs alike."""
    scene = SCENES[name]
    solver = _solver(scene)
    worlds = range(LANES)
    runs = {s: DifferentiableRollout(solver, storage=s, memory=MEMORY) for s in ("full", "replay")}
    plain: list[float] = []
    taped: dict[str, list[float]] = {s: [] for s in runs}
    swept: dict[str, list[float]] = {s: [] for s in runs}
    for repeat in range(repeats + 1):  # the first one loads kernels and finds sizes
        _start(solver, scene, repeat)
        begin = time.process_time()
        rollout(solver, worlds, least=1e3, most=scene.seconds)
        plain.append(time.process_time() - begin)
        for storage, run in runs.items():
            _start(solver, scene, repeat)
            begin = time.process_time()
            ends = run.forward(worlds, [scene.seconds])
            middle = time.process_time()
            run.backward(np.ones_like(ends), bodies=np.ones_like(run.body_poses))
            taped[storage].append(middle - begin)
            swept[storage].append(time.process_time() - middle)
    per = scene.seconds * LANES
    base = float(np.median(plain[1:]))
    costs = []
    for storage, run in runs.items():
        forward, backward = np.median(taped[storage][1:]), np.median(swept[storage][1:])
        costs.append(
            Cost(
                scene=name,
                storage=storage,
                plain_ms=1e3 * base / per,
                taped_ms=1e3 * float(forward) / per,
                backward_ms=1e3 * float(backward) / per,
                taped_ratio=float(forward) / base,
                backward_ratio=float(backward) / base,
                memory_mb=run.recorder.nbytes / 1e6 / per,
            )
        )
    return costs


def _solver(scene: Scene) -> SolverFusedXPBD:
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    scene.add(one)
    builder.replicate(one, LANES)
    return SolverFusedXPBD(builder.finalize(device="cpu"), scene.solver, lanes=LANES)


def _start(solver: SolverFusedXPBD, scene: Scene, repeat: int) -> None:
    solver.data.reset()
    for world in range(LANES):
        rng = np.random.default_rng([repeat, world])
        if solver.data.has_particles:
            solver.data.lane("particles.x", world)[:] = scene.start(rng)
            solver.data.lane("particles.v", world)[:] = 0.0
        if scene.bodies is not None:
            solver.data.set_bodies(world, *scene.bodies(rng))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    quiet_warp()
    rows: list[Cost] = []
    print("| scene | storage | plain | taped | backward | taped / plain | backward / plain | MB |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.scenes:
        for cost in measure(name, options.repeats):
            rows.append(cost)
            print(
                f"| {cost.scene} | {cost.storage} | {cost.plain_ms:.3f} | {cost.taped_ms:.3f} "
                f"| {cost.backward_ms:.3f} | {cost.taped_ratio:.2f} | {cost.backward_ratio:.2f} "
                f"| {cost.memory_mb:.2f} |",
                flush=True,
            )
    if options.json:
        print(json.dumps({"rows": [asdict(cost) for cost in rows]}))


if __name__ == "__main__":
    main()
