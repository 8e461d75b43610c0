"""What becomes of bags that are thrown, pulled open, loaded with a box and carried.

    python benchmarks/bag.py [--drops 200] [--items 64] [--set edge_contact=0.2] [--quick]

Prints a table; judges nothing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.bag_scenes import (
    CENTRE,
    CUBE,
    SHELL,
    bag_solver,
    carry,
    collapsed,
    flat_box,
    leaks,
    pierced,
    poke,
    pull,
    throw,
    timed,
)
from fixtures.cloth_scenes import edge_ratios
from fixtures.solver_scenes import G, spring_energy

from warp_deform.objects import Bag, BagConfig, BoxConfig
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import Frames, GripPath, rollout
from warp_deform.solver import SolverFusedXPBD
from warp_deform.support.quaternion import quat_from_yaw
from warp_deform.tasks.metrics import hull_area

DT, LANES, FIRST_SEED = 1 / 1200, 8, 5000
PUSHED, MOST = 0.2, 4.2  # [s]
EVERY = 10  # substeps between looks

Table = dict[str, list[float]]


def opening(x: np.ndarray, bag: Bag) -> float:
    """Area of the opening seen from above, as a share of the undeformed one."""
    return hull_area(x[list(bag.ring), :2]) / (np.pi * bag.config.opening_radius**2)


def worst_rise(solver: SolverFusedXPBD, world: int, frames: Frames) -> float:
    """Largest rise of the energy over an earlier value, after the push, over the first value."""
    x = frames.particle_q
    at = np.arange(EVERY, len(x), EVERY)
    mass = 1.0 / solver.data.lane("particles.w0", world)
    v = (x[at].astype(float) - x[at - 1]) / DT
    top = solver.data.topologies[0]
    total = 0.5 * (mass[:, None] * v**2).sum((1, 2)) + G * x[at].astype(float)[..., 2] @ mass
    total += spring_energy(top, x[at])
    later = total[at * DT > PUSHED + 0.02]
    first = G * mass @ x[0, :, 2].astype(float)
    ahead = np.maximum.accumulate(later[::-1])[::-1]
    return float((ahead - later).max() / first)


def last_moving(frames: Frames, limit: float = 0.005) -> float:
    """When a vertex was last faster than `limit` [m/s] [s]."""
    step = np.linalg.norm(np.diff(frames.particle_q[::EVERY], axis=0), axis=2).max(1)
    fast = np.flatnonzero(step > limit * EVERY * DT)
    return float((fast[-1] + 1) * EVERY * DT) if len(fast) else 0.0


def state(table: Table, x: np.ndarray, bag: Bag, what: str) -> None:
    """Measures of a bag at rest."""
    table[f"{what} pierced edges"].append(pierced(x, bag.faces))
    table[f"{what} opening"].append(opening(x, bag))
    ratios = edge_ratios(x, SHELL.vertices, bag.faces)
    table[f"{what} smallest edge"].append(float(ratios.min()))
    table[f"{what} p99 edge"].append(float(np.percentile(ratios, 99)))
    table[f"{what} smallest triangle"].append(float(collapsed(x, bag.faces).min()))


def drops(count: int, config: BagConfig, *, pulls: int) -> tuple[Table, float]:
    """Throw bags, then pull each open; the table, and CPU seconds per simulated second."""
    table: Table = defaultdict(list)
    solver, (bag,) = bag_solver(min(LANES, count), config=config, lanes=LANES)
    cpu = simulated = 0.0
    for first in range(0, count, LANES):
        worlds = range(min(LANES, count - first))
        pushes = {w: (throw(solver, w, FIRST_SEED + first + w),) for w in worlds}
        begin = time.process_time()
        result = rollout(
            solver, worlds, pushes=pushes, min_seconds=PUSHED, max_seconds=MOST, record=DT
        )
        cpu += time.process_time() - begin
        for w in worlds:
            r = result[w]
            simulated += r.seconds
            assert r.frames is not None
            x = r.frames.particle_q
            table["drop seconds to rest"].append(last_moving(r.frames) if r.at_rest else np.inf)
            table["drop energy rise [%]"].append(100 * worst_rise(solver, w, r.frames))
            table["drop lowest vertex [mm]"].append(1e3 * x[..., 2].min())
            seen = [edge_ratios(f, SHELL.vertices, bag.faces) for f in x[::40]]
            table["drop p99 edge, worst moment"].append(max(np.percentile(e, 99) for e in seen))
            table["drop longest edge, worst moment"].append(max(e.max() for e in seen))
            table["drop guard stretch"].append(r.watch.stretch)
            table["drop overflow"].append(r.watch.overflow)
            table["drop clamped"].append(r.watch.clamped)
            state(table, solver.particle_q(w), bag, "drop")
        for _ in range(pulls):
            paths = {w: pull(solver.particle_q(w), bag.ring, config.opening_radius) for w in worlds}
            result = rollout(solver, worlds, paths=paths, min_seconds=0.1, max_seconds=9.0)
            for w in worlds:
                rest = result[w].seconds - paths[w].times[-1] if result[w].at_rest else np.inf
                table["pull seconds to rest"].append(rest)
                table["pull overflow"].append(result[w].watch.overflow)
        for w in worlds:
            if pulls:
                state(table, solver.particle_q(w), bag, f"{pulls} pulls")
    return table, cpu / simulated


def insertion(box: BoxConfig, rng: np.random.Generator) -> GripPath:
    """Carry the box over the standing bag, turned anyhow; lower it until it touches; let go."""
    x0 = np.array([0.5, 0.35, -box.lowest])
    at = CENTRE + rng.uniform(-0.025, 0.025, 2)
    knots = [x0, [*x0[:2], 0.3], [*at, 0.3], [*at, 0.02]]
    times, knots = timed(knots, 0.4)
    yaw = rng.uniform(0, 2 * np.pi)
    turns = quat_from_yaw(np.array([0, 0, yaw, yaw]))
    return GripPath(times, knots, body=0, rotations=turns, lower=(times[2], times[3]))


def items(count: int, config: BagConfig, sizes: str) -> Table:
    """Put a box into a standing bag, carry the bag by one bead, set it down."""
    table: Table = defaultdict(list)
    rng = np.random.default_rng(7)
    for first in range(0, count, LANES):
        box = CUBE if sizes == "cube" else flat_box(rng.uniform(0.015, 0.055))
        size = box.parts[0].size
        worlds = range(min(LANES, count - first))
        solver, (bag,) = bag_solver(len(worlds), boxes=(box,), config=config, lanes=LANES)
        insert = {w: insertion(box, rng) for w in worlds}
        one = rollout(
            solver, worlds, paths=insert, min_seconds=0.2, max_seconds=9.0, record=1 / 240
        )
        lift = {}
        for w in worlds:
            bead = bag.ring[rng.integers(len(bag.ring))]
            angle = rng.uniform(0, 2 * np.pi)
            way = 0.5 * np.array([np.cos(angle), np.sin(angle)])
            lift[w] = carry(solver.particle_q(w)[bead], bead, way)
        two = rollout(solver, worlds, paths=lift, min_seconds=0.2, max_seconds=13.0, record=1 / 240)
        for w in worlds:
            held, gone = one[w].frames, two[w].frames
            assert held is not None and gone is not None
            table["insert seconds to rest"].append(
                one[w].seconds - insert[w].times[-1] if one[w].at_rest else np.inf
            )
            table["carry seconds to rest"].append(
                two[w].seconds - lift[w].times[-1] if two[w].at_rest else np.inf
            )
            x = np.concatenate([held.particle_q, gone.particle_q])
            q = np.concatenate([held.body_q, gone.body_q])[:, 0]
            table["leaks"].append(leaks(q[::2, :3], x[::2], bag.faces))
            pokes = [
                1e3 * poke(a, bag.faces, b, size) for a, b in zip(x[::12], q[::12], strict=True)
            ]
            table["deepest poke [mm]"].append(max(pokes))
            table["p99 poke [mm]"].append(float(np.percentile(pokes, 99)))
            cut = len(held.times) // 12
            table["poke while inserting [mm]"].append(max(pokes[:cut]))
            lifted = np.searchsorted(gone.times, lift[w].times[1])
            table["aloft with the bag"].append(gone.body_q[lifted, 0, 2] > 0.05)
            seen = [edge_ratios(f, SHELL.vertices, bag.faces) for f in x[::12]]
            table["p99 edge, worst moment"].append(max(np.percentile(e, 99) for e in seen))
            table["longest edge, worst moment"].append(max(e.max() for e in seen))
            ratios = edge_ratios(x[-1], SHELL.vertices, bag.faces)
            table["longest edge at the end"].append(float(ratios.max()))
            table["pierced edges at the end"].append(pierced(x[-1], bag.faces))
            table["guard stretch"].append(max(one[w].watch.stretch, two[w].watch.stretch))
            table["lowest vertex [mm]"].append(1e3 * x[..., 2].min())
            table["overflow"].append(max(one[w].watch.overflow, two[w].watch.overflow))
    return table


def show(title: str, table: Table) -> None:
    print(f"\n{title}")
    print(f"  {'':34} {'least':>8} {'median':>8} {'p95':>8} {'most':>8}   n")
    for name, values in table.items():
        v = np.array(values, dtype=float)
        finite = v[np.isfinite(v)]
        if not len(finite):
            finite = np.array([np.nan])
        row = [finite.min(), np.median(finite), np.percentile(finite, 95), v.max()]
        print(f"  {name:34} " + " ".join(f"{value:8.3f}" for value in row) + f"  {len(v):4d}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_AS_WRITTEN)
    parser.add_argument("--drops", type=int, default=200)
    parser.add_argument("--items", type=int, default=64)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="a value of BagConfig, e.g. --set edge_contact=0.2",
    )
    parser.add_argument("--quick", action="store_true", help="8 drops, 8 items of each kind")
    options = parser.parse_args()
    if options.quick:
        options.drops = options.items = 8
    quiet_warp()
    values = dict(pair.split("=") for pair in options.set)
    config = BagConfig(**{name: float(value) for name, value in values.items()})
    if options.drops:
        table, cost = drops(options.drops, config, pulls=3)
        show("thrown, then pulled three times", table)
        print(f"  {1e3 * cost:.0f} ms CPU per simulated second and world while settling")
        wide = np.mean(np.array(table["drop opening"]) >= 0.7)
        print(f"  {100 * wide:.1f} % open before any pull")
    for sizes in ("cube", "flat") if options.items else ():
        show(f"a box of kind {sizes} carried in the bag", items(options.items, config, sizes))


_AS_WRITTEN = argparse.RawDescriptionHelpFormatter

if __name__ == "__main__":
    main()
