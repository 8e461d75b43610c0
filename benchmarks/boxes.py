"""How many boxes sink into boxes under them, and how far towers of boxes drift.

    python benchmarks/boxes.py [--quick] [--json]

Random pairs (`random_pairs`: of one size or not, at any yaw, in line or off, some at a small tilt)
stand for a second. A box has sunk when it lies deeper than 0.1 mm in the other by the hull of their
Minkowski difference, which the simulation does not use, or stands lower than its size by so much.
Towers of cubes of 4 cm and 50 g stand for 10 s, in line and turned and shifted at random.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.box_scenes import pair_solver, place_pairs, poses, random_pairs, tower

from warp_deform.collecting.workers import single_threaded
from warp_deform.quiet import quiet_warp

PAIRS = 10_000
AT_ONCE = 500
SECOND = 1200
SUNK = 1e-4
"""Deeper than this has sunk [m]."""
WIDTHS = (("float32", 8), ("float32", 1), ("float64", 1))
"""Precisions and lanes."""
TOWERS = (2, 6, 10, 15)
RATIOS = (1, 10, 30, 100)


@dataclass(frozen=True)
class Row:
    """Worlds of one kind after so many seconds.

    Attributes:
        scene: "pairs", "tower" (in line), "turned" (a tower) or "heavy" (a cube on a lighter one)
        ratio: mass of the uppermost cube over that of the others
        deepest_mm: that boxes of a pair lie in each other
        drift_mm: the farthest that a box of a tower is from where it was built
        guards: worlds that a guard named
    """

    scene: str
    precision: str
    lanes: int
    worlds: int
    boxes: int
    ratio: float
    seconds: int
    sunk: int
    deepest_mm: float
    drift_mm: float
    guards: int
    cpu_ms_per_second: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    quiet_warp()
    quick = options.quick
    with single_threaded():
        found = [
            pairs(precision, lanes, AT_ONCE if quick else PAIRS) for precision, lanes in WIDTHS
        ]
        for boxes in (2,) if quick else TOWERS:
            found += [towers("tower", boxes, 1.0, 1), towers("turned", boxes, 1.0, 8)]
        found += [towers("heavy", 2, float(ratio), 1) for ratio in RATIOS]
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in found]}))
        return
    print("| scene | precision | lanes | worlds | boxes | ratio | sunk | deepest mm | drift mm |")
    print("|---" * 9 + "|")
    for row in found:
        print(
            f"| {row.scene} | {row.precision} | {row.lanes} | {row.worlds} | {row.boxes} "
            f"| {row.ratio:.0f} | {row.sunk} | {row.deepest_mm:.3f} | {row.drift_mm:.3f} |"
        )


def pairs(precision: str, lanes: int, count: int) -> Row:
    """The same pairs whatever the precision and the lanes."""
    solver = pair_solver(AT_ONCE, precision=precision, lanes=lanes)
    solver.run(1)
    sunk = guards = 0
    deepest = cpu = 0.0
    for seed in range(count // AT_ONCE):
        drawn = random_pairs(AT_ONCE, seed)
        place_pairs(solver, drawn)
        began = time.process_time()
        values = solver.run(SECOND)
        cpu += time.process_time() - began
        x, turns = poses(solver)
        depths = drawn.sunk(x, turns)
        sunk += int(((depths > SUNK) | (drawn.risen(x) < -SUNK)).sum())
        deepest = max(deepest, float(depths.max()))
        guards += sum(v.problems(0, solver.config.limits) != () for v in values)
    return Row(
        "pairs", precision, lanes, count, 2, 1.0, 1, sunk, 1e3 * deepest, 0.0, guards,
        1e3 * cpu / count,
    )  # fmt: skip


def towers(scene: str, boxes: int, ratio: float, worlds: int) -> Row:
    masses = [0.05] * (boxes - 1) + [0.05 * ratio]
    turned = {"seed": 0, "off": 0.002} if scene == "turned" else {}
    solver = tower([0.04] * boxes, masses, worlds=worlds, precision="float32", lanes=1, **turned)
    solver.run(1)
    solver.data.reset()
    start, _ = poses(solver)
    began = time.process_time()
    values = solver.run(10 * SECOND)
    cpu = time.process_time() - began
    drift = np.abs(poses(solver)[0] - start).max()
    guards = sum(v.problems(0, solver.config.limits) != () for v in values)
    return Row(
        scene, "float32", 1, worlds, boxes, ratio, 10, 0, 0.0, 1e3 * float(drift), guards,
        1e2 * cpu / worlds,
    )  # fmt: skip


if __name__ == "__main__":
    main()
