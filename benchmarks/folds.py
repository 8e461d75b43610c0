"""How many edges of a folded sheet pierce it, with and without contact between edges, and the cost.

    python benchmarks/folds.py [--quick] [--json]

Sheets of 10 x 10 and of 25 x 25 particles, side by side in lanes: a random particle of the rim is
carried a random way over the sheet, and, once it is at rest, any particle of the heap as far again.
The fabric of the tasks is folded four times, so that it ends as a heap of several layers.
Edges are counted exactly at rest after each. Costs are of the same rollouts, in CPU ms per
simulated second and sheet, and speak for no other machine; their ratio does.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.cloth_scenes import cloth_solver, edge_ratios, edges_of, fold_path, piercing

from warp_deform.collecting.workers import single_threaded
from warp_deform.objects import ClothConfig
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import rollout
from warp_deform.solver import SolverConfig
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER, FABRIC, FABRIC_SOLVER

SHEETS = {10: 16, 25: 8}
"""Rows of a sheet, and how many sheets are folded."""
OF_TASKS = 32
"""Sheets of the tasks' fabric that are folded."""


@dataclass(frozen=True)
class Row:
    """Sheets at rest after one of their folds.

    Attributes:
        fabric: "plain", of `ClothConfig`'s defaults but for what is named here, or "tasks"
        edge_contact: share of `ClothConfig`
        pierced_least, pierced_mean, pierced_most: edges of a sheet that pierce it
        shortest: edge of all sheets, over its rest length
        guards: sheets that a guard stopped
    """

    fabric: str
    rows: int
    edge_contact: float
    fold: int
    sheets: int
    edges: int
    pierced_least: int
    pierced_mean: float
    pierced_most: int
    shortest: float
    guards: int
    cpu_ms_per_second: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    quiet_warp()
    with single_threaded():
        results = [
            row
            for rows, sheets in (((10, 2),) if options.quick else SHEETS.items())
            for edge_contact in (0.0, 0.2)
            for row in folded(rows, sheets, edge_contact)
        ]
        results += folded_in_tasks(8 if options.quick else OF_TASKS)
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in results]}, indent=1))
        return
    print("| fabric | rows | edge contact | fold | pierced | mean | of | shortest | CPU ms |")
    print("|---" * 9 + "|")
    for row in results:
        print(
            f"| {row.fabric} | {row.rows} | {row.edge_contact} | {row.fold} | {row.pierced_least} "
            f"to {row.pierced_most} | {row.pierced_mean:.2f} | {row.edges} | {row.shortest:.2f} "
            f"| {row.cpu_ms_per_second:.1f} |"
        )


def folded(rows: int, sheets: int, edge_contact: float) -> list[Row]:
    """Fold sheets twice; the draws are the same with and without contact between edges."""
    config = replace(ClothConfig(), rows=rows, columns=rows, edge_contact=edge_contact)
    return _folded("plain", config, CLOTH_SOLVER, sheets, 2)


def folded_in_tasks(sheets: int) -> list[Row]:
    """Fold the fabric of the tasks four times."""
    return _folded("tasks", FABRIC, FABRIC_SOLVER, sheets, 4)


def _folded(
    fabric: str, config: ClothConfig, physics: SolverConfig, sheets: int, folds: int
) -> list[Row]:
    solver, cloth = cloth_solver(config, worlds=sheets, lanes=8, config=physics)
    flat = _positions(solver, 0)
    rim = np.flatnonzero((np.abs(flat[:, :2] - [0.5, 0.0]).max(axis=1)) > 0.099)
    measured, rng = [], np.random.default_rng(0)
    # compiled, and the kernels' caches filled, before anything is timed
    rollout(solver, range(sheets), max_seconds=0.05)
    for fold in range(1, folds + 1):
        choices = rim if fold == 1 else np.arange(len(flat))
        paths = {}
        for w in range(sheets):
            particle = int(rng.choice(choices))
            at = _positions(solver, w)[particle]
            inwards = rng.normal(0, 0.04, 2) + 1.2 * (np.array([0.5, 0.0]) - at[:2])
            paths[w] = fold_path(at, tuple(inwards), particle=particle)
        began = time.process_time()
        results = rollout(solver, range(sheets), paths=paths, min_seconds=1.2, max_seconds=2.5)
        cpu = time.process_time() - began
        ends = [_positions(solver, w) for w in range(sheets)]
        pierced = [piercing(x, cloth.faces) for x in ends]
        measured.append(
            Row(
                fabric=fabric,
                rows=config.rows,
                edge_contact=config.edge_contact,
                fold=fold,
                sheets=sheets,
                edges=len(edges_of(cloth.faces)),
                pierced_least=min(pierced),
                pierced_mean=float(np.mean(pierced)),
                pierced_most=max(pierced),
                shortest=min(float(edge_ratios(x, flat, cloth.faces).min()) for x in ends),
                guards=sum(
                    results[w].watch.problems(w, solver.config.limits) != () for w in range(sheets)
                ),
                cpu_ms_per_second=1e3 * cpu / sum(results[w].seconds for w in range(sheets)),
            )
        )
    return measured


def _positions(solver: object, world: int) -> np.ndarray:
    return solver.data.lane("particles.x", world).astype(float)  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
