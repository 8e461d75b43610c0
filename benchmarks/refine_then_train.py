"""Who should demonstrate: the same agent from as many demonstrations, made in five ways.

    python benchmarks/refine_then_train.py [--tasks T...] [--ways W...] [--demos N...]
                                           [--seeds S...] [--steps N] [--work FOLDER]
                                           [--out FILE] [--list] [--costs FILE] [--picks FILE]

A cell is a task, a way, a number of demonstrations and a seed of training. Agent, steps and test
are the same in all, and the last snapshot is tested, so that nothing is chosen by luck; so are the
starts, where all ways solve them. `cem` and `gradient` are
what `warp-deform refine --accept solved` makes of the scripted demonstrations; `mpc` and `planner`
demonstrate themselves. Each finished cell is a line of OUT, and a cell with a line is left out: the
command goes on after an interruption. Two processes may share WORK and OUT, with different tasks.
With `--costs` demonstrations are only made, in a folder that is thrown away, and their CPU seconds
are added to FILE; those of a refined way are of its scripted demonstrations too. One demonstration
before, not timed, loads the kernels. With `--picks` the demonstrations in WORK are read, and how
visible the reason of their actions is is written to FILE.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from table import tested_by

from learning.refinement.refine import RefineConfig, refine
from learning.report.read import read_runs
from learning.sweep import Collecting, SweepConfig, run_sweep
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.inspection import statistics
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import WarpDeformError
from warp_deform.planning import SearchConfig
from warp_deform.support.revision import running_revision
from warp_deform.tasks.registry import task as find_task

RESULTS = Path("benchmarks/results/refine_then_train.jsonl")
TASKS = ("cable-ring", "cable-shape", "fabric-flat-notarget", "bag-items-1")
WAYS = ("scripted", "cem", "gradient", "mpc", "planner")
REFINED = ("cem", "gradient")
Cell = tuple[str, str, int, int]
"""Task, way, demonstrations, seed of training."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--demos", nargs="+", type=int, default=(10,))
    parser.add_argument("--seeds", nargs="+", type=int, default=(0,))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--episodes", type=int, help="of the test: 200, and 100 with bags")
    parser.add_argument("--work", type=Path, default=Path("refine-then-train"))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--list", action="store_true", help="only name what is left")
    parser.add_argument("--costs", type=Path, help="file for CPU seconds of demonstrations alone")
    parser.add_argument("--picks", type=Path, help="file for what demonstrations pick and place")
    options = parser.parse_args()
    if options.picks is not None:
        with options.picks.open("w") as file:
            for demos, task, way in product(options.demos, options.tasks, options.ways):
                folder = options.work / "demos" / way / str(demos) / task
                if folder.exists():
                    row = {"task": task, "way": way, "demos": demos, **picks_of(folder)}
                    file.write(json.dumps(row) + "\n")
        return
    if options.costs is not None:
        for demos, task, way in product(options.demos, options.tasks, options.ways):
            if way != "gradient" or find_task(task).has_loss():
                with options.costs.open("a") as file:
                    file.write(json.dumps(cost_of(task, way, demos)) + "\n")
        return
    grid = product(options.seeds, options.demos, options.tasks, options.ways)
    left = missing(
        [(task, way, demos, seed) for seed, demos, task, way in grid], options.steps, options.out
    )
    if options.list:
        print("\n".join(map(name_of, left)))
        return
    failed = [cell for cell in left if not fill(cell, options)]
    if failed:
        sys.exit(f"{len(failed)} cells failed: {', '.join(map(name_of, failed))}")


def name_of(cell: Cell) -> str:
    """A cell in a word."""
    return "-".join(map(str, cell))


def missing(cells: Sequence[Cell], steps: int, out: Path) -> list[Cell]:
    """Cells that can be made and have no line of results; no gradient leads bags anywhere."""
    lines = out.read_text().splitlines() if out.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {
        (row["task"], row["way"], row["demos"], row["seed"])
        for row in rows
        if row["steps"] == steps
    }
    return [
        cell
        for cell in cells
        if cell not in done and (cell[1] != "gradient" or find_task(cell[0]).has_loss())
    ]


def fill(cell: Cell, options: argparse.Namespace) -> bool:
    """Make, train, evaluate and write down one cell; whether it went well."""
    task, way, demos, seed = cell
    work: Path = options.work / name_of(cell)
    try:
        folder = demonstrate(task, way, demos, options.work / "demos")
        grid = SweepConfig(
            out=work,
            tasks=(task,),
            agents=("goal-split" if find_task(task).goal_conditioned else "transporter",),
            demos=(demos,),
            seeds=(seed,),
            preset="fast",
            steps=options.steps,
            snapshots=1,
            validate=0,
            demonstrations=Collecting(folder=folder.parent, count=demos),
            evaluation=replace(tested_by(task, options.episodes), validation_episodes=1),
        )
        if run_sweep(grid, workers=1)["failed"]:
            return False
    except WarpDeformError as error:
        print(f"{name_of(cell)}: {error}", file=sys.stderr)
        return False
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("a") as file:
        row = json.dumps(row_of(cell, options.steps, folder, work / "runs")) + "\n"
        file.write(row)
    print(row, end="")
    return True


def demonstrate(task: str, way: str, demos: int, root: Path) -> Path:
    """A folder of the task's demonstrations made in this way; what is there is kept."""
    made = root / (way if way not in REFINED else "scripted") / str(demos) / task
    by: Any = "scripted" if way in REFINED else way
    collected = collect(
        CollectConfig(task=task, episodes=demos, out=made, demonstrator=by, workers=1)
    )
    if collected.successes < demos:
        raise WarpDeformError(f"{by} solves {task} too seldom for {demos} demonstrations")
    if way not in REFINED:
        return made
    refined = root / way / str(demos) / task
    search = SearchConfig(method=way)
    refine(RefineConfig(source=made, out=refined, accept="solved", search=search, workers=1))
    return refined


def cost_of(task: str, way: str, demos: int) -> dict[str, Any]:
    """CPU seconds that so many demonstrations take in this process."""
    with tempfile.TemporaryDirectory() as root:
        demonstrate(task, way, 1, Path(root))
        began = time.process_time()
        demonstrate(task, way, demos, Path(root))
        spent = time.process_time() - began
    return {"task": task, "way": way, "demos": demos, "cpu_s": spent,
            "commit": running_revision().commit}  # fmt: skip


def picks_of(folder: Path) -> dict[str, Any]:
    """Medians over the actions of demonstrations.

    `farther`: share of the beads or nodes that are farther from where they lie in the end than the
    picked one; 0 where the action begins with what is most out of place, as a picture shows.
    `place_mm`: how far the place is from where the picked one lies in the end [mm].
    """
    farther, off = [], []
    reader = EpisodeReader(folder)
    for seed in reader.seeds:
        *steps, last = reader.read(seed).steps
        end = np.asarray(last.particle_q)[:, :2]
        for step in steps:
            action, q = np.asarray(step.action), np.asarray(step.particle_q)[:, :2]
            picked = int(np.argmin(np.linalg.norm(q - action[:2], axis=1)))
            distances = np.linalg.norm(q - end, axis=1)
            farther.append(float((distances > distances[picked]).mean()))
            off.append(1000 * float(np.linalg.norm(action[3:5] - end[picked])))
    return {
        "actions": len(off),
        "farther": float(np.median(farther)),
        "place_mm": float(np.median(off)),
        "place_mm_p90": float(np.percentile(off, 90)),
    }


def row_of(cell: Cell, steps: int, folder: Path, runs: Path) -> dict[str, Any]:
    """What a cell came to."""
    (run,), _ = read_runs([runs])
    shown, test = statistics(folder), run.info["test"]
    return {
        **dict(zip(("task", "way", "demos", "seed"), cell, strict=True)),
        "agent": run.agent,
        "steps": steps,
        "labels": shown["steps"],
        "demonstrated_score": shown["mean_score"],
        "n_success": test["n_success"],
        "n_success_enclosed": test["n_success_enclosed"],
        "n_episodes": test["n_episodes"],
        "score": test["mean_score"],
        "score_error": test["standard_error"],
        "value": test["paper_value"],
        "mean_actions": test["mean_actions"],
        "training_cpu_s": run.info["training_cpu_seconds"],
        "commit": running_revision().commit,
    }


if __name__ == "__main__":
    main()
