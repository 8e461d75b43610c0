"""The demonstrators beside each other: success, mean actions, CPU seconds an attempt.

    python benchmarks/demonstrators.py [--tasks cable-ring] [--seeds 50] [--quick] [--json]

Plays whole episodes in this process on the same seeds, eight side by side, with the images that a
collection would render. One episode before each row, not timed, compiles or loads the kernels.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass

import numpy as np

from warp_deform.demonstrators import DEMONSTRATORS, demonstrator
from warp_deform.episode_loop import SOLVED, Run, play, worlds_for
from warp_deform.episodes import Step
from warp_deform.quiet import quiet_warp
from warp_deform.recording import observe
from warp_deform.tasks.registry import TASKS
from warp_deform.workers import single_threaded

WARM_UP = 999_000  # seed


@dataclass(frozen=True)
class Row:
    """A task played by a demonstrator; actions are of all attempts."""

    task: str
    demonstrator: str
    attempts: int
    successes: int
    mean_actions: float
    mean_score: float
    cpu_s_per_attempt: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--demonstrators", nargs="+", default=list(DEMONSTRATORS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    if options.quick:
        options.tasks, options.seeds = ["block-notarget"], 2
    quiet_warp()
    seeds = range(options.first, options.first + options.seeds)
    rows = []
    if not options.json:
        print("| task | demonstrator | successes / attempts | mean actions | CPU s an attempt |")
        print("|---|---|---|---|---|")
    for task in options.tasks:
        for name in options.demonstrators:
            row = measure(task, name, seeds)
            rows.append(row)
            if not options.json:
                print(
                    f"| {task} | {name} | {row.successes} / {row.attempts} "
                    f"| {row.mean_actions:.2f} | {row.cpu_s_per_attempt:.3f} |",
                    flush=True,
                )
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in rows]}))


def measure(task: str, name: str, seeds: range) -> Row:
    """Play every seed once."""
    worlds, act = worlds_for(task, "ur5"), demonstrator(name)

    def attempt(seeds: range) -> list[Run[Step]]:
        return [run for _, run in play(worlds, seeds, act=act, look=observe)]

    with single_threaded():
        attempt(range(WARM_UP, WARM_UP + 1))
        began = time.process_time()
        runs = attempt(seeds)
        cpu = time.process_time() - began
    return Row(
        task=task,
        demonstrator=name,
        attempts=len(runs),
        successes=sum(run.ended == SOLVED for run in runs),
        mean_actions=float(np.mean([len(run.actions) for run in runs])),
        mean_score=float(np.mean([run.rows[-1].score if run.rows else 0.0 for run in runs])),
        cpu_s_per_attempt=cpu / len(runs),
    )


if __name__ == "__main__":
    main()
