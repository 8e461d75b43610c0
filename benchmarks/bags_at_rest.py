"""How far thrown bags move once they are at rest, asleep as in the tasks, and without sleep.

    python benchmarks/bags_at_rest.py [--bags 40] [--out benchmarks/results/bags_at_rest.json]

Bags are thrown and come to rest. Then 1.5 s go by: once as they are, and once from the same places
and from rest in a solver without sleep, at once and after some seconds without sleep. A bag's
movement is that of its worst vertex.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.bag_scenes import BAG_SOLVER, bag_solver, throw

from warp_deform.quiet import quiet_warp
from warp_deform.rollout import rollout
from warp_deform.solver import SolverFusedXPBD
from warp_deform.support.revision import running_revision

LANES = 8
FIRST = 5000  # seed
SECONDS = 1.5
SETTLED = (0.0, 1.5, 6.0)
"""Seconds without sleep before the movement is measured."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--bags", type=int, default=40, help="a multiple of 8")
    parser.add_argument("--out", type=Path, help="a JSON file for the rows")
    options = parser.parse_args()
    if options.bags < LANES or options.bags % LANES:
        parser.error(f"--bags is a multiple of {LANES}, not {options.bags}")
    quiet_warp()
    awake, _ = bag_solver(LANES, lanes=LANES, solver=replace(BAG_SOLVER, sleep_speed=0.0))
    moved: dict[str, list[float]] = {}
    for first in range(FIRST, FIRST + options.bags, LANES):
        solver, _ = bag_solver(LANES, lanes=LANES)
        pushes = {w: (throw(solver, w, first + w),) for w in range(LANES)}
        ends = rollout(solver, range(LANES), pushes=pushes, min_seconds=0.2, max_seconds=6.2)
        assert all(end.at_rest for end in ends.values()), "a bag did not come to rest"
        places = positions(solver)
        moved.setdefault("asleep", []).extend(wait(solver))
        for w, place in enumerate(places):
            awake.data.lane("particles.x", w)[:] = place
            awake.data.lane("particles.v", w)[:] = 0.0
        gone = 0.0
        for settled in SETTLED:
            if settled > gone:
                rollout(awake, range(LANES), min_seconds=settled - gone, max_seconds=settled - gone)
            moved.setdefault(f"without sleep, after {settled:g} s", []).extend(wait(awake))
            gone = settled + SECONDS
    rows = [
        {"way": way, "bags": len(mm), "median_mm": float(np.median(mm)), "most_mm": max(mm)}
        for way, mm in moved.items()
    ]
    for row in rows:
        print(json.dumps(row))
    if options.out:
        report = {"rows": rows, "revision": asdict(running_revision())}
        options.out.write_text(json.dumps(report, indent=1) + "\n")


def positions(solver: SolverFusedXPBD) -> list[np.ndarray]:
    """Of every world's particles (P, 3) [m]."""
    return [solver.particle_q(w).copy() for w in range(LANES)]


def wait(solver: SolverFusedXPBD) -> list[float]:
    """Movement [mm] of the worst vertex of every world in `SECONDS`."""
    before = positions(solver)
    rollout(solver, range(LANES), min_seconds=SECONDS, max_seconds=SECONDS)
    pairs = zip(positions(solver), before, strict=True)
    return [1e3 * float(np.linalg.norm(now - then, axis=1).max()) for now, then in pairs]


if __name__ == "__main__":
    main()
