"""The table of all tasks: what has no result yet is trained, evaluated and kept, cell by cell.

    python benchmarks/table.py [--tasks T...] [--agents A...] [--demos N...] [--seeds S...]
                               [--work FOLDER] [--out FOLDER] [--list]

A cell is a task, an agent, a number of demonstrations and a seed of training. Results are written
under OUT/runs when a cell ends, and a cell with a result on the present version of its task is left
out: the command goes on after an interruption, and on another machine with nothing but OUT. Runs
and demonstrations are in WORK. Two processes may share both, with different tasks.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

from learning_results import check_in

from learning.evaluation.paper_results import read_paper
from learning.policy.policy import AGENTS
from learning.report.report import write_report
from learning.runs.folder import RunFolder
from learning.sweep import Collecting, Evaluating, SweepConfig, run_sweep
from warp_deform.errors import WarpDeformError
from warp_deform.tasks.registration import env_id

RESULTS = Path("benchmarks/results/table")
DEMOS = (10, 100, 1)
"""Numbers of demonstrations in the order in which they are worth knowing."""
TASKS = (
    "block-notarget",
    "cable-line-notarget",
    "fabric-cover",
    "fabric-flat",
    "fabric-flat-notarget",
    "cable-ring",
    "cable-ring-notarget",
    "cable-shape",
    "cable-shape-notarget",
    "bag-alone-open",
    "bag-items-1",
    "bag-color-goal",
    "bag-items-2",
)
"""The paper's tasks, cheap ones first."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--agents", nargs="+", choices=tuple(AGENTS), default=tuple(AGENTS))
    parser.add_argument("--demos", nargs="+", type=int, default=DEMOS)
    parser.add_argument("--seeds", nargs="+", type=int, default=(0,))
    parser.add_argument("--steps", type=int, help="in place of the schedule's")
    parser.add_argument("--episodes", type=int, help="of the test: 200, and 100 with bags")
    parser.add_argument("--work", type=Path, default=Path("table"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--list", action="store_true", help="only name what is left")
    options = parser.parse_args()
    left = missing(
        options.tasks, options.agents, options.demos, options.seeds, options.out, options.steps
    )
    if options.list:
        print("\n".join(folder_of(cell) for cell in left))
        return
    failed = [cell for cell in left if not fill(cell, options)]
    if failed:
        sys.exit(f"{len(failed)} cells failed: {', '.join(map(folder_of, failed))}")
    print(write_report([options.out / "runs"], options.out).text)


Cell = tuple[str, str, int, int]
"""Task, agent, demonstrations, seed."""


def folder_of(cell: Cell, steps: int | None = None) -> str:
    """The folder of a cell's result."""
    return "-".join(map(str, cell)) + ("" if steps is None else f"-{steps}-steps")


def missing(
    tasks: Sequence[str],
    agents: Sequence[str],
    demos: Sequence[int],
    seeds: Sequence[int],
    out: Path,
    steps: int | None = None,
) -> list[Cell]:
    """Cells of the paper's table without a result on the present version of their task.

    Few demonstrations of cheap tasks first.
    """
    paper = read_paper()
    kept = out / "runs"
    return [
        (task, agent, count, seed)
        for seed, count, task, agent in product(seeds, demos, tasks, agents)
        if agent in paper.agents(task)
        and not is_of(kept / folder_of((task, agent, count, seed), steps), task)
    ]


def is_of(folder: Path, task: str) -> bool:
    """Whether a folder has a result on the present version of a task."""
    run = RunFolder(folder)
    return run.report.exists() and run.read_report().get("environment") == env_id(task)


def fill(cell: Cell, options: argparse.Namespace) -> bool:
    """Train, evaluate and write down one cell; whether it went well."""
    task, agent, count, seed = cell
    try:
        done = run_sweep(
            SweepConfig(
                out=options.work / folder_of(cell),
                tasks=(task,),
                agents=(agent,),
                demos=(count,),
                seeds=(seed,),
                preset="fast",
                steps=options.steps,
                demonstrations=Collecting(folder=options.work / "demos", count=max(options.demos)),
                evaluation=tested_by(task, options.episodes),
            ),
            workers=1,
        )
    except WarpDeformError as error:
        print(f"{folder_of(cell)}: {error}", file=sys.stderr)
        return False
    if not done["failed"]:
        check_in([options.work / folder_of(cell) / "runs"], options.out)
    return not done["failed"]


def tested_by(task: str, episodes: int | None = None) -> Evaluating:
    """How a cell is evaluated: with fewer episodes where they take long, unless it is said."""
    return Evaluating(episodes=episodes or (100 if "bag" in task else 200))


if __name__ == "__main__":
    main()
