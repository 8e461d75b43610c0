"""What derivatives cost: taped forward and backward beside the plain forward, in the same run.

    python benchmarks/gradients.py [--scenes cable cable-alone heap cloth10 bag] [--json]

Process CPU milliseconds per simulated second and world, 8 worlds in 8 lanes (cable-alone: one in a
lane of its own), float32, kernels compiled before, the least over repeats that take turns; MB (10^6
bytes) of tape and checkpoints at their peak likewise. `full` keeps every tape, `replay` checkpoints
and one tape, and its backward runs every segment again; `auto` keeps tapes in a quarter of the
memory. `parts` is a backward with derivatives by single springs and particles.

What bounds it: `substep_bytes` are on the tape per substep and world; `plain_ns` and `backward_ns`
are nanoseconds per constraint that acted.
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
from typing import Any

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
from warp_deform.xpbd.recording.recorder import STORAGES

LANES = 8
CABLE, CLOTH, BAG = CableConfig(), ClothConfig(), BagConfig()
BOX = BoxConfig(parts=(BoxPart((0.035, 0.035, 0.03)),), mass=0.1, friction=1.5)
BLOCK = l_block()
MEMORY = 2**30
NO_CONSTRAINTS = {"contact_slowed", "table_slip", "body_slip", "speed_clamp", "release", "reached"}
"""What is counted beside what it belongs to."""


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
    lanes: int = LANES
    often: int = 1
    """Repeats for each one that is asked for: short runs are measured more often."""


@dataclass(frozen=True)
class Cost:
    """Times in CPU ms, memory in MB, per simulated second and world; ratios to the plain run."""

    scene: str
    storage: str
    lanes: int
    plain_ms: float
    taped_ms: float
    backward_ms: float
    parts_ms: float
    taped_ratio: float
    backward_ratio: float
    whole_ratio: float
    whole_with_parts_ratio: float
    memory_mb: float
    substep_bytes: float
    plain_ns: float
    backward_ns: float


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
        often=10,
    ),
    "cable-alone": Scene(
        lambda b: add_cable(b, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))),
        SolverConfig(),
        1.0,
        _crumpled,
        lanes=1,
        often=10,
    ),
    "heap": Scene(
        lambda b: add_cable(b, CABLE, cable_line(CABLE, (0.4, 0.0), (0.6, 0.0))),
        SolverConfig(),
        1.0,
        _heap,
        often=10,
    ),
    "cloth10": Scene(
        lambda b: add_cloth(b, CLOTH, cloth_sheet(CLOTH, (0.5, 0.0))),
        CLOTH_SOLVER,
        0.5,
        _sheet,
        often=4,
    ),
    "bag": Scene(lambda b: add_bag(b, BAG), BAG_SOLVER, 0.25, _bag),
    "bag-cube": Scene(_add_bag_and_boxes, BAG_SOLVER, 0.25, _bag, _boxes),
    "block": Scene(
        lambda b: add_box(b, BLOCK, (0.5, 0.0, -BLOCK.lowest)),
        SolverConfig(table_friction=1.0, contact_friction=1.0),
        1.0,
        _no_particles,
        _sliding,
        often=10,
    ),
}


def measure(name: str, repeats: int) -> list[Cost]:
    """Costs of one scene with each storage; all runs start alike and take turns."""
    scene = SCENES[name]
    solver = _solver(scene)
    worlds = range(scene.lanes)
    runs = {s: DifferentiableRollout(solver, storage=s, memory=MEMORY) for s in STORAGES}
    spent: dict[tuple[str, str], float] = {}
    counts: dict[str, int] = {}

    def timed(storage: str, what: str, run: Callable[[], Any]) -> Any:
        begin = time.process_time()
        result = run()
        took = time.process_time() - begin
        spent[storage, what] = min(took, spent.get((storage, what), np.inf))
        return result

    for repeat in range(repeats * scene.often + 1):  # the first one loads kernels and finds sizes
        if repeat == 1:
            spent.clear()
        _start(solver, scene)
        timed(
            "", "plain", lambda: rollout(solver, worlds, min_seconds=1e3, max_seconds=scene.seconds)
        )
        for storage, run in runs.items():
            _start(solver, scene)
            ends = timed(storage, "taped", lambda run=run: run.forward(worlds, [scene.seconds]))
            by = {"positions": np.ones_like(ends), "bodies": np.ones_like(run.body_poses)}
            for what, parts in (("backward", False), ("parts", True)):
                found = timed(
                    storage, what, lambda run=run, by=by, on=parts: run.backward(**by, parts=on)
                )
            counts = found.counts()
    per = scene.seconds * scene.lanes
    base = spent["", "plain"]
    tape = [s.tape for s in runs["full"].recorder._segments if s.tape is not None]
    used = sum(float((t.used() * runs["full"].recorder._room.sizes).sum()) for t in tape)
    acted = sum(n for kind, n in counts.items() if kind not in NO_CONSTRAINTS)
    costs = []
    for storage, run in runs.items():
        forward, backward, of_parts = (spent[storage, w] for w in ("taped", "backward", "parts"))
        costs.append(
            Cost(
                scene=name,
                storage=storage,
                lanes=scene.lanes,
                plain_ms=1e3 * base / per,
                taped_ms=1e3 * forward / per,
                backward_ms=1e3 * backward / per,
                parts_ms=1e3 * of_parts / per,
                taped_ratio=forward / base,
                backward_ratio=backward / base,
                whole_ratio=(forward + backward) / base,
                whole_with_parts_ratio=(forward + of_parts) / base,
                memory_mb=run.recorder.nbytes / 1e6 / per,
                substep_bytes=used / (per / solver.config.dt),
                plain_ns=1e9 * base / acted,
                backward_ns=1e9 * backward / acted,
            )
        )
    return costs


def _solver(scene: Scene) -> SolverFusedXPBD:
    one, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for part in (one, builder):
        SolverFusedXPBD.register_custom_attributes(part)
    scene.add(one)
    builder.replicate(one, scene.lanes)
    return SolverFusedXPBD(builder.finalize(device="cpu"), scene.solver, lanes=scene.lanes)


def _start(solver: SolverFusedXPBD, scene: Scene) -> None:
    solver.data.reset()
    for world in range(scene.lanes):
        rng = np.random.default_rng(world)
        if solver.data.has_particles:
            solver.data.lane("particles.x", world)[:] = scene.start(rng)
            solver.data.lane("particles.v", world)[:] = 0.0
        if scene.bodies is not None:
            solver.data.set_bodies(world, *scene.bodies(rng))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    options = parser.parse_args()
    quiet_warp()
    rows: list[Cost] = []
    print("| scene | storage | plain | taped | backward | whole / plain | with parts | MB |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.scenes:
        for cost in measure(name, options.repeats):
            rows.append(cost)
            print(
                f"| {cost.scene} | {cost.storage} | {cost.plain_ms:.3f} | {cost.taped_ms:.3f} "
                f"| {cost.backward_ms:.3f} | {cost.whole_ratio:.2f} "
                f"| {cost.whole_with_parts_ratio:.2f} | {cost.memory_mb:.2f} |",
                flush=True,
            )
    if options.json:
        print(json.dumps({"rows": [asdict(cost) for cost in rows]}))


if __name__ == "__main__":
    main()
