"""Whether tasks depend on the substep: demonstrators and shapes at rest with shorter ones.

    python benchmarks/convergence.py [--tasks cable-ring] [--seeds 100] [--out rows.jsonl]
    python benchmarks/convergence.py --table --out benchmarks/results/convergence.jsonl

The scripted demonstrator plays the same seeds with the task's substep, a half of it and a quarter.
Episodes are chaotic, so the same seed ends elsewhere with every substep; what is compared are means
over all seeds, of success, actions and score, and of the starts, which no action has touched: their
score, how far their particles are from their middle, and how high the highest one is. Intervals are
1.96 standard errors. Rows that are already in the file of --out are not measured again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from warp_deform.collecting.recording import observe
from warp_deform.collecting.workers import single_threaded
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import TASKS
from warp_deform.tasks.task import Task
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SOLVED, play

DIVISORS = (1, 2, 4)
FIRST = 60_000  # seed, of none that anything was chosen with
SLOTS = 8


@dataclass(frozen=True)
class Row:
    """A task with its substep divided by a number; an error is half the width of an interval."""

    task: str
    divisor: int
    substep: float
    """[s]"""
    attempts: int
    successes: int
    actions: float
    actions_error: float
    score: float
    score_error: float
    start_score: float
    start_score_error: float
    radius: float
    """Of the start: root mean square distance of the particles from their middle, along x and y
    [mm]; of boxes where there are no particles."""
    radius_error: float
    height: float
    """Of the start: of the highest particle, or box [mm]."""
    height_error: float
    guards: int
    """Episodes that a guard ended."""
    cpu_s_per_attempt: float


def finer(task: type[Task], divisor: int) -> type[Task]:
    """The task with a substep that is `divisor` times as short."""
    solver = replace(task.solver, dt=task.solver.dt / divisor)
    return type(task.__name__, (task,), {"solver": solver, "__module__": task.__module__})


def measure(name: str, divisor: int, count: int) -> Row:
    """Play `count` episodes; says on stderr how far it is."""
    task = finer(TASKS[name], divisor)
    worlds = Worlds(task(), SLOTS, lanes=SLOTS)
    act = demonstrator("scripted")
    starts: list[tuple[float, float, float]] = []
    ends: list[tuple[bool, int, float, bool]] = []
    began = time.process_time()
    for slot, run in play(worlds, range(FIRST, FIRST + count), act=act, look=observe):
        ends.append(
            (
                run.ended == SOLVED,
                len(run.actions),
                run.rows[-1].score if run.rows else 0.0,
                worlds.episodes[slot].physics_ok,
            )
        )
        print(f"\r{name} / {divisor} {len(ends)}/{count}", end="", file=sys.stderr)
    cpu = time.process_time() - began
    print(file=sys.stderr)
    for first in range(FIRST, FIRST + count, SLOTS):
        seeds = range(first, min(first + SLOTS, FIRST + count))
        worlds.reset(dict(enumerate(seeds)))
        starts += [shape(worlds, slot) for slot in range(len(seeds))]
    solved, actions, scores, sound = zip(*ends, strict=True)
    start_scores, radii, heights = zip(*starts, strict=True)
    return Row(
        task=name,
        divisor=divisor,
        substep=task.solver.dt,
        attempts=count,
        successes=sum(solved),
        actions=float(np.mean(actions)),
        actions_error=error(actions),
        score=float(np.mean(scores)),
        score_error=error(scores),
        start_score=float(np.mean(start_scores)),
        start_score_error=error(start_scores),
        radius=float(np.mean(radii)),
        radius_error=error(radii),
        height=float(np.mean(heights)),
        height_error=error(heights),
        guards=sum(not each for each in sound),
        cpu_s_per_attempt=cpu / count,
    )


def shape(worlds: Worlds, slot: int) -> tuple[float, float, float]:
    """Score, radius [mm] and height [mm] of what is at rest in a world."""
    episode = worlds.episodes[slot]
    snapshot = episode.snapshot
    x = snapshot.particle_q if len(snapshot.particle_q) else snapshot.body_q[:, :3]
    x = np.asarray(x, dtype=float)
    away = x[:, :2] - x[:, :2].mean(axis=0)
    radius = float(np.sqrt((away**2).sum(axis=1).mean()))
    score = worlds.task.score(episode.layout, snapshot)
    return score, 1e3 * radius, 1e3 * float(x[:, 2].max())


def error(values: Sequence[float]) -> float:
    """1.96 standard errors of a mean."""
    return float(1.96 * np.std(values) / np.sqrt(max(len(values) - 1, 1)))


def table(rows: list[Row]) -> str:
    """The table of docs/convergence.md."""
    lines = [
        "| task | divided by | solved | actions | score | of starts | radius [mm] | height [mm] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: (list(TASKS).index(row.task), row.divisor)):
        lines.append(
            f"| {row.task} | {row.divisor} | {row.successes} / {row.attempts} "
            f"| {row.actions:.2f} ± {row.actions_error:.2f} "
            f"| {row.score:.3f} ± {row.score_error:.3f} "
            f"| {row.start_score:.3f} ± {row.start_score_error:.3f} "
            f"| {row.radius:.1f} ± {row.radius_error:.1f} "
            f"| {row.height:.1f} ± {row.height_error:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--out", type=Path, help="file of JSON lines to which rows are added")
    parser.add_argument("--table", action="store_true", help="print the rows of --out")
    options = parser.parse_args()
    rows = read(options.out)
    if not options.table:
        quiet_warp()
        done = {(row.task, row.divisor, row.attempts) for row in rows}
        for name in options.tasks:
            for divisor in DIVISORS:
                if (name, divisor, options.seeds) in done:
                    continue
                with single_threaded():
                    rows.append(measure(name, divisor, options.seeds))
                if options.out:
                    with options.out.open("a") as file:
                        file.write(json.dumps(asdict(rows[-1])) + "\n")
    print(table(rows))


def read(path: Path | None) -> list[Row]:
    """The rows of a file; none where there is no file yet."""
    if path is None or not path.exists():
        return []
    return [Row(**json.loads(line)) for line in path.read_text().splitlines()]


if __name__ == "__main__":
    main()
