"""The demonstrators beside each other: success, actions, CPU seconds, and how the sheets fare.

    python benchmarks/demonstrators.py [--tasks cable-ring] [--seeds 50] [--out rows.jsonl]

Plays whole episodes in this process on the same seeds, eight side by side, with the images that a
collection would render. One episode before each row, not timed, compiles or loads the kernels.
With --out, rows already in that file are not measured again. Intervals are Wilson's, 95 %.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from bag_scenes import pierced
from cloth_scenes import edges_of

from warp_deform.demonstrators import DEMONSTRATORS, demonstrator
from warp_deform.episode_loop import SOLVED, play, worlds_for
from warp_deform.episodes import Step
from warp_deform.objects import Bag, Cloth
from warp_deform.quiet import quiet_warp
from warp_deform.recording import observe
from warp_deform.tasks.registry import TASKS
from warp_deform.workers import single_threaded
from warp_deform.worlds import Worlds

WARM_UP = 999_000  # seed


@dataclass(frozen=True)
class Row:
    """A task played by a demonstrator."""

    task: str
    demonstrator: str
    first_seed: int
    attempts: int
    successes: int
    interval: tuple[float, float]
    """Wilson's, of the success rate, 95 %."""
    mean_actions: float
    """Of all attempts."""
    mean_actions_solved: float
    mean_score: float
    cpu_s_per_attempt: float
    states: int
    """How many states at rest were looked at: each start, and what followed every action."""
    still_moving: int
    """How many of them were not at rest when their time was up."""
    pierced: dict[str, float]
    """Share of a state's edges that pierce a triangle: mean, p95, worst; share of states above 2 %.
    Empty for tasks without a sheet."""


@dataclass
class Watch:
    """What is seen of every state at rest; its own cost is not the demonstrator's."""

    pierced: list[float] = field(default_factory=list)
    states: int = 0
    still_moving: int = 0
    cpu: float = 0.0

    def look(self, worlds: Worlds, slot: int) -> Step:
        step = observe(worlds, slot)
        began = time.process_time()
        episode = worlds.episodes[slot]
        self.states += 1
        self.still_moving += not episode.at_rest
        for thing in episode.snapshot.objects:
            if isinstance(thing, Bag | Cloth):
                x, faces = episode.snapshot.particle_q, np.asarray(thing.faces)
                self.pierced.append(pierced(x, faces) / len(edges_of(faces)))
        self.cpu += time.process_time() - began
        return step

    def shares(self) -> dict[str, float]:
        if not self.pierced:
            return {}
        v = np.array(self.pierced)
        return {
            "mean": float(v.mean()),
            "p95": float(np.percentile(v, 95)),
            "worst": float(v.max()),
            "above 2 %": float((v > 0.02).mean()),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--demonstrators", nargs="+", default=list(DEMONSTRATORS))
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--out", type=Path, help="file of JSON lines to which rows are added")
    options = parser.parse_args()
    if options.quick:
        options.tasks, options.seeds = ["block-notarget"], 2
    quiet_warp()
    done = _rows(options.out)
    rows = []
    if not options.json:
        print("| task | demonstrator | successes / attempts | 95 % | mean actions "
              "| CPU s an attempt | pierced edges, mean / worst state |")  # fmt: skip
        print("|---|---|---|---|---|---|---|")
    for task in options.tasks:
        for name in options.demonstrators:
            seeds = range(options.first, options.first + options.seeds)
            row = done.get((task, name, options.first, options.seeds)) or measure(task, name, seeds)
            rows.append(row)
            if options.out and (task, name, options.first, options.seeds) not in done:
                with options.out.open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
            if not options.json:
                print(_line(row), flush=True)
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in rows]}))


def measure(task: str, name: str, seeds: range) -> Row:
    """Play every seed once; says on stderr how far it is."""
    worlds, act = worlds_for(task, "ur5"), demonstrator(name)
    with single_threaded():
        list(play(worlds, [WARM_UP], act=act, look=observe))
        watch, runs = Watch(), []
        began = time.process_time()
        for _, run in play(worlds, seeds, act=act, look=watch.look):
            runs.append(run)
            print(f"\r{task} {name} {len(runs)}/{len(seeds)}", end="", file=sys.stderr)
        cpu = time.process_time() - began - watch.cpu
    print(file=sys.stderr)
    solved = [run for run in runs if run.ended == SOLVED]
    interval = binomtest(len(solved), len(runs)).proportion_ci(method="wilson")
    return Row(
        task=task,
        demonstrator=name,
        first_seed=seeds.start,
        attempts=len(runs),
        successes=len(solved),
        interval=(float(interval.low), float(interval.high)),
        mean_actions=float(np.mean([len(run.actions) for run in runs])),
        mean_actions_solved=float(np.mean([len(run.actions) for run in solved] or [np.nan])),
        mean_score=float(np.mean([run.rows[-1].score if run.rows else 0.0 for run in runs])),
        cpu_s_per_attempt=cpu / len(runs),
        states=watch.states,
        still_moving=watch.still_moving,
        pierced=watch.shares(),
    )


def _rows(path: Path | None) -> dict[tuple[str, str, int, int], Row]:
    """Rows measured before, by task, demonstrator, first seed and number of seeds."""
    if path is None or not path.exists():
        return {}
    rows = [Row(**json.loads(line)) for line in path.read_text().splitlines()]
    return {(row.task, row.demonstrator, row.first_seed, row.attempts): row for row in rows}


def _line(row: Row) -> str:
    low, high = row.interval
    shares = row.pierced
    edges = f"{100 * shares['mean']:.2f} / {100 * shares['worst']:.1f} %" if shares else "-"
    return (
        f"| {row.task} | {row.demonstrator} | {row.successes} / {row.attempts} "
        f"| {100 * low:.1f}-{100 * high:.1f} % | {row.mean_actions:.2f} "
        f"| {row.cpu_s_per_attempt:.3f} | {edges} |"
    )


if __name__ == "__main__":
    main()
