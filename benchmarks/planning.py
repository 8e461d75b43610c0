"""Ways to choose actions beside each other, at the same number of simulated actions a choice.

    python benchmarks/planning.py [--tasks cable-ring] [--seeds 50] [--budget 64] [--out rows.jsonl]

`scripted` and `mpc` (8 simulated actions a choice) are the demonstrators; `enumerate`, `random`,
`cem` and `gradient` look one action ahead, `planner` (cem) two. Plays whole episodes in this
process on the same seeds. With --out, rows already in that file are not measured again. Intervals
are Wilson's, 95 %; those of mean actions and scores are 1.96 standard errors.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from warp_deform.demonstrators import demonstrator, planner
from warp_deform.episode_loop import SOLVED, Act, play, worlds_for
from warp_deform.planning import SearchConfig
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import TASKS
from warp_deform.workers import single_threaded
from warp_deform.worlds import Worlds

WARM_UP = 999_000  # seed
METHODS: dict[str, Callable[[int], Act[Any]]] = {
    "scripted": lambda _: demonstrator("scripted"),
    "mpc": lambda _: demonstrator("mpc"),
    **{
        name: partial(lambda name, n: planner(SearchConfig(method=name, depth=1, budget=n)), name)
        for name in ("enumerate", "random", "cem", "gradient")
    },
    "planner": lambda n: planner(SearchConfig(budget=n)),
}


@dataclass(frozen=True)
class Row:
    """A task played by a method; actions and scores are of all attempts, with half-widths."""

    task: str
    method: str
    budget: int
    first_seed: int
    attempts: int
    successes: int
    interval: tuple[float, float]
    mean_actions: float
    actions_error: float
    mean_score: float
    score_error: float
    cpu_s_per_attempt: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--budget", type=int, default=64, help="simulated actions a choice")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--out", type=Path, help="file of JSON lines to which rows are added")
    options = parser.parse_args()
    if options.quick:
        options.tasks, options.seeds, options.budget = ["block-notarget"], 2, 4
    quiet_warp()
    done = _rows(options.out)
    rows = []
    if not options.json:
        print("| task | method | successes / attempts | 95 % | mean actions | mean score "
              "| CPU s an attempt |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for task in options.tasks:
        for method in options.methods:
            key = (task, method, options.budget, options.first, options.seeds)
            row = done.get(key) or measure(*key)
            rows.append(row)
            if options.out and key not in done:
                with options.out.open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
            if not options.json:
                print(_line(row), flush=True)
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in rows]}))


def measure(task: str, method: str, budget: int, first: int, count: int) -> Row:
    """Play every seed once; says on stderr how far it is."""
    worlds, act = worlds_for(task, "ur5"), METHODS[method](budget)
    with single_threaded():
        list(play(worlds, [WARM_UP], act=act, look=Worlds.score))
        runs = []
        began = time.process_time()
        for _, run in play(worlds, range(first, first + count), act=act, look=Worlds.score):
            runs.append(run)
            print(f"\r{task} {method} {len(runs)}/{count}", end="", file=sys.stderr)
        cpu = time.process_time() - began
    print(file=sys.stderr)
    solved = sum(run.ended == SOLVED for run in runs)
    interval = binomtest(solved, count).proportion_ci(method="wilson")
    actions = np.array([len(run.actions) for run in runs], dtype=float)
    scores = np.array([run.rows[-1] if run.rows else 0.0 for run in runs])
    error = 1.96 / np.sqrt(max(count - 1, 1))
    return Row(
        task=task,
        method=method,
        budget=budget,
        first_seed=first,
        attempts=count,
        successes=solved,
        interval=(float(interval.low), float(interval.high)),
        mean_actions=float(actions.mean()),
        actions_error=float(error * actions.std()),
        mean_score=float(scores.mean()),
        score_error=float(error * scores.std()),
        cpu_s_per_attempt=cpu / count,
    )


def _rows(path: Path | None) -> dict[tuple[str, str, int, int, int], Row]:
    """Rows measured before."""
    if path is None or not path.exists():
        return {}
    rows = [Row(**json.loads(line)) for line in path.read_text().splitlines()]
    return {(r.task, r.method, r.budget, r.first_seed, r.attempts): r for r in rows}


def _line(row: Row) -> str:
    low, high = row.interval
    return (
        f"| {row.task} | {row.method} | {row.successes} / {row.attempts} "
        f"| {100 * low:.1f}-{100 * high:.1f} % | {row.mean_actions:.2f} ± {row.actions_error:.2f} "
        f"| {row.mean_score:.3f} ± {row.score_error:.3f} | {row.cpu_s_per_attempt:.2f} |"
    )


if __name__ == "__main__":
    main()
