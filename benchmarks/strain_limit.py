"""How far the edges of a hanging sheet exceed their strain limit, while it falls and at the end.

    python benchmarks/strain_limit.py [--quick] [--json]

Sheets of 0.2 kg and 0.2 m, of 25 x 25 and of 50 x 50 particles, whose edges may get 1.1 times as
long as at rest. They start upright or flat, are pinned somewhere, and swing for 1.5 s. Every fourth
substep is looked at. Costs are in CPU ms per simulated second, and speak for no other machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.pinned_sheets import edge_strains, pinned_sheet
from fixtures.solver_scenes import frames

from warp_deform.collecting.workers import single_threaded
from warp_deform.objects import ClothConfig
from warp_deform.quiet import quiet_warp

SECONDS = 1.5
EVERY = 4
SCENES = {
    "upright, by two corners": (True, ((-1, 0), (-1, -1))),
    "upright, by one corner": (True, ((-1, 0),)),
    "flat, by two corners of a row": (False, ((-1, 0), (-1, -1))),
    "flat, by two corners of a column": (False, ((0, 0), (-1, 0))),
    "flat, by opposite corners": (False, ((0, 0), (-1, -1))),
    "flat, by four corners": (False, ((0, 0), (0, -1), (-1, 0), (-1, -1))),
}
"""Whether a sheet starts upright, and the rows and columns of its pins."""


@dataclass(frozen=True)
class Row:
    """A sheet that fell.

    Attributes:
        rows: of particles, and so many columns
        solve: of `ClothConfig`
        falling: longest edge ever, over its rest length
        at_end: longest edge in the end
    """

    scene: str
    rows: int
    solve: str
    falling: float
    at_end: float
    cpu_ms_per_second: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    quiet_warp()
    first = next(iter(SCENES))
    with single_threaded():
        results = [
            fallen(scene, rows, solve)
            for rows in ((10,) if options.quick else (25, 50))
            for solve in ("direct", "gauss-seidel")
            for scene in SCENES
            if solve == "direct" or scene == first
        ]
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in results]}, indent=1))
        return
    print("| scene | rows | solve | falling | at the end | CPU ms |")
    print("|---" * 6 + "|")
    for row in results:
        print(
            f"| {row.scene} | {row.rows} | {row.solve} | {row.falling:.3f} | {row.at_end:.3f} "
            f"| {row.cpu_ms_per_second:.0f} |"
        )


def fallen(scene: str, rows: int, solve: str) -> Row:
    """Let a sheet fall."""
    sheet = replace(ClothConfig(), rows=rows, columns=rows, solve=solve)
    upright, pins = SCENES[scene]
    pinned_sheet(sheet, pins, upright=upright).run(1)  # compiled before it is timed
    solver = pinned_sheet(sheet, pins, upright=upright)
    began = time.process_time()
    path = frames(solver, round(SECONDS / solver.config.dt), EVERY)
    spent = time.process_time() - began
    strains = edge_strains(sheet, path)
    return Row(
        scene=scene,
        rows=rows,
        solve=solve,
        falling=float(strains.max()),
        at_end=float(strains[-1].max()),
        cpu_ms_per_second=round(1e3 * spent / SECONDS, 1),
    )


if __name__ == "__main__":
    main()
