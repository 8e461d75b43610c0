"""Who chooses actions how well: success, actions, CPU seconds, and how the sheets fare.

    python benchmarks/demonstrators.py [--tasks cable-ring] [--seeds 50] [--out rows.jsonl]
    python benchmarks/demonstrators.py --by scripted mpc enumerate cem gradient refined-cem
    python benchmarks/demonstrators.py --hardness --out benchmarks/results/demonstrators.jsonl

Besides the demonstrators there are the searches of `warp_deform.planning`, which may simulate
`--budget` actions a choice and look `--depth` actions ahead (`enumerate` one ahead is `mpc` with
that budget), and `refined-`: successful episodes of the scripted demonstrator refined by a search,
those with fewer actions accepted where both solve the task (`refine --accept solved`).
Plays whole episodes in this process on the same seeds, eight side by side, with the images that a
collection would render. One episode before each row, not timed, compiles or loads the kernels. With
--out, rows already in that file are not measured again; --hardness then prints its rows of the
scripted demonstrators beside the paper's, and --bags those of bags, with rows of neighbouring seeds
taken together.
Intervals of rates are Wilson's, others 1.96 standard errors, 95 %.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from fixtures.bag_scenes import pierced
from fixtures.cloth_scenes import edges_of

from learning.refinement.refine import RefineConfig, refine
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.recording import observe
from warp_deform.collecting.workers import single_threaded
from warp_deform.episodes import EpisodeReader, Step
from warp_deform.objects import Bag, Cloth
from warp_deform.planning import METHODS, SearchConfig
from warp_deform.planning.demonstrators import DEMONSTRATORS, demonstrator, planner
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import TASKS
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SOLVED, play, worlds_for

WARM_UP = 999_000  # seed
ORDER = ("scripted", "visible", "mpc")
PAPER: dict[str, tuple[float | None, float]] = {
    row["task"]: (row["paper_success"], row["paper_actions"])
    for row in map(
        json.loads, Path(__file__).with_name("paper_demonstrators.jsonl").read_text().splitlines()
    )
}
"""Success [%] of the original's demonstrator, and mean actions of the demonstrations kept.

Source: Seita et al., ICRA 2021 (arXiv:2012.03385v4), tables of tasks and of demonstrations.
"""
REFINED = tuple(f"refined-{method}" for method in METHODS)
WITH_MORE = ("gradient+lifts", "gradient+joint")
"""A search with an option of `SearchConfig` that is off by default."""


@dataclass(frozen=True)
class Row:
    """A task played by a demonstrator or a search."""

    task: str
    by: str
    budget: int | None
    """Simulated actions a choice; None where it is not ours to set."""
    depth: int | None
    """Actions that a search looks ahead."""
    first_seed: int
    attempts: int
    successes: int
    interval: tuple[float, float]
    """Wilson's, of the success rate, 95 %."""
    mean_actions: float
    """Of all attempts, with the half-width of its interval below."""
    actions_error: float
    mean_actions_solved: float
    mean_score: float
    score_error: float
    cpu_s_per_attempt: float
    states: int
    """How many states at rest were looked at: each start, and what followed every action."""
    still_moving: int
    """How many of them were not at rest when their time was up."""
    pierced: dict[str, float]
    """Share of a state's edges that pierce a triangle: mean, p95, worst; share of states above 2 %.
    Empty for tasks without a sheet."""
    enclosed: int | None = None
    """Successes whose items the bag enclosed, see `Task.enclosed`; None without bag or item."""


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
    parser.add_argument(
        "--by",
        nargs="+",
        default=["scripted", "visible", "mpc"],
        choices=[*DEMONSTRATORS, *METHODS, *REFINED, *WITH_MORE],
    )
    parser.add_argument("--budget", type=int, default=64, help="simulated actions a choice")
    parser.add_argument(
        "--depth",
        type=int,
        nargs="+",
        default=[2],
        choices=[1, 2],
        help="actions that searches look ahead",
    )
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--compact", action="store_true", help="a table of mean actions by task")
    parser.add_argument("--out", type=Path, help="file of JSON lines to which rows are added")
    parser.add_argument("--hardness", action="store_true", help="the table of docs/hardness.md")
    parser.add_argument("--bags", action="store_true", help="its table of the bags")
    options = parser.parse_args()
    if options.hardness or options.bags:
        rows = list(_rows(options.out).values())
        print(hardness(rows) if options.hardness else bags(rows))
        return
    if options.quick:
        options.tasks, options.seeds, options.budget = ["block-notarget"], 2, 4
    quiet_warp()
    done = _rows(options.out)
    rows = []
    in_lines = not (options.json or options.compact)
    if in_lines:
        print(
            "| task | by | successes / attempts | 95 % | mean actions | mean score "
            "| CPU s an attempt | pierced edges, mean / worst state |"
        )
        print("|---|---|---|---|---|---|---|---|")
    for task, name in itertools.product(options.tasks, options.by):
        searches = name in (*METHODS, *REFINED, *WITH_MORE)
        for depth in options.depth if searches else [None]:
            budget = options.budget if searches else None
            key = (task, name, budget, depth, options.first, options.seeds)
            row = done.get(key) or measure(*key)
            rows.append(row)
            if options.out and key not in done:
                with options.out.open("a") as file:
                    file.write(json.dumps(asdict(row)) + "\n")
            if in_lines:
                print(_line(row), flush=True)
    if options.compact:
        print(_compact(rows))
    if options.json:
        print(json.dumps({"rows": [asdict(row) for row in rows]}))


def measure(
    task: str, by: str, budget: int | None, depth: int | None, first: int, count: int
) -> Row:
    """Play every seed once; says on stderr how far it is."""
    search = None
    if budget is not None and depth is not None:
        method, _, more = by.removeprefix("refined-").partition("+")
        search = SearchConfig(
            method=method, budget=budget, depth=depth, lifts=more == "lifts", joint=more == "joint"
        )
    with single_threaded():
        watch = Watch()
        if by in REFINED:
            assert search is not None
            solved, actions, scores, cpu = refined(task, search, first, count)
            enclosed: list[bool | None] = [None]
        else:
            act = demonstrator(by) if search is None else planner(search)
            worlds, seeds = worlds_for(task, "ur5"), range(first, first + count)
            list(play(worlds, [WARM_UP], act=act, look=observe))
            runs, enclosed = [], []
            began = time.process_time()
            for slot, run in play(worlds, seeds, act=act, look=watch.look):
                runs.append(run)
                inside = worlds.enclosed(slot) if run.rows else None
                enclosed.append(None if inside is None else inside and run.ended == SOLVED)
                print(f"\r{task} {by} {len(runs)}/{count}", end="", file=sys.stderr)
            cpu = time.process_time() - began - watch.cpu
            print(file=sys.stderr)
            solved = [run.ended == SOLVED for run in runs]
            actions = [len(run.actions) for run in runs]
            scores = [run.rows[-1].score if run.rows else 0.0 for run in runs]
    interval = binomtest(sum(solved), count).proportion_ci(method="wilson")
    error = 1.96 / np.sqrt(max(count - 1, 1))
    return Row(
        task=task,
        by=by,
        budget=budget,
        depth=depth,
        first_seed=first,
        attempts=count,
        successes=sum(solved),
        interval=(float(interval.low), float(interval.high)),
        mean_actions=float(np.mean(actions)),
        actions_error=float(error * np.std(actions)),
        mean_actions_solved=float(np.mean(np.array(actions)[solved] if any(solved) else np.nan)),
        mean_score=float(np.mean(scores)),
        score_error=float(error * np.std(scores)),
        cpu_s_per_attempt=cpu / count,
        states=watch.states,
        still_moving=watch.still_moving,
        pierced=watch.shares(),
        enclosed=None if all(each is None for each in enclosed) else sum(map(bool, enclosed)),
    )


def refined(
    task: str, search: SearchConfig, first: int, count: int
) -> tuple[list[bool], list[int], list[float], float]:
    """Success, actions and score of refined demonstrations, and CPU s of making all of them."""
    with tempfile.TemporaryDirectory() as folder:
        demos, out = Path(folder, "demos"), Path(folder, "refined")
        warm = replace(search, budget=2)
        for n, seed, by in ((1, WARM_UP, warm), (count, first, search)):
            began = time.process_time()
            collect(CollectConfig(task=task, episodes=n, seed=seed, out=demos / str(n), workers=1))
            refine(
                RefineConfig(
                    source=demos / str(n), out=out / str(n), search=by, accept="solved", workers=1
                )
            )
            cpu = time.process_time() - began
        infos = EpisodeReader(out / str(count)).infos()
    return (
        [info.success for info in infos],
        [info.actions for info in infos],
        [info.score for info in infos],
        cpu,
    )


def _rows(path: Path | None) -> dict[tuple[str, str, int | None, int | None, int, int], Row]:
    """Rows measured before, by what `measure` is called with."""
    if path is None or not path.exists():
        return {}
    rows = [Row(**json.loads(line)) for line in path.read_text().splitlines()]
    return {(r.task, r.by, r.budget, r.depth, r.first_seed, r.attempts): r for r in rows}


@dataclass(frozen=True)
class Pooled:
    """Rows of neighbouring seeds taken together."""

    task: str
    by: str
    attempts: int
    successes: int
    enclosed: int | None
    mean_actions: float
    mean_actions_solved: float
    cpu_s_per_attempt: float


def pooled(rows: list[Row]) -> list[Pooled]:
    """One a task and demonstrator, of all seeds that its rows played; in the tasks' order."""
    together: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.first_seed):
        together.setdefault((row.task, row.by), []).append(row)
    pools = [_pool(parts) for parts in together.values()]
    return sorted(pools, key=lambda each: (list(TASKS).index(each.task), ORDER.index(each.by)))


def _pool(parts: list[Row]) -> Pooled:
    for a, b in itertools.pairwise(parts):
        if a.first_seed + a.attempts != b.first_seed:
            raise SystemExit(f"{a.task} {a.by}: seeds are missing, or twice, before {b.first_seed}")
    attempts, solved = sum(r.attempts for r in parts), sum(r.successes for r in parts)
    enclosed = [row.enclosed for row in parts if row.enclosed is not None]
    of_solved = sum(r.mean_actions_solved * r.successes for r in parts if r.successes)
    return Pooled(
        task=parts[0].task,
        by=parts[0].by,
        attempts=attempts,
        successes=solved,
        enclosed=sum(enclosed) if enclosed else None,
        mean_actions=sum(r.mean_actions * r.attempts for r in parts) / attempts,
        mean_actions_solved=of_solved / solved if solved else np.nan,
        cpu_s_per_attempt=sum(r.cpu_s_per_attempt * r.attempts for r in parts) / attempts,
    )


def hardness(rows: list[Row]) -> str:
    """The scripted demonstrators beside the paper's: success, and actions of the successes."""
    lines = [
        "| task | attempts | success | paper | ratio | enclosed | actions | paper | ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    mine = {row.task: row for row in pooled(rows) if row.by == "scripted"}
    for task, (success, actions) in PAPER.items():
        row = mine[task]
        rate = 100 * row.successes / row.attempts
        theirs, ratio = ("-", "-") if success is None else (f"{success} %", f"{rate / success:.2f}")
        enclosed = "-" if row.enclosed is None else f"{100 * row.enclosed / row.attempts:.1f} %"
        ours = row.mean_actions_solved
        lines.append(
            f"| {task} | {row.attempts} | {rate:.1f} % | {theirs} | {ratio} | {enclosed} "
            f"| {ours:.2f} | {actions:.2f} | {ours / actions:.2f} |"
        )
    return "\n".join(lines)


def bags(rows: list[Row]) -> str:
    """The bags' demonstrators: successes, how many enclosed, mean actions, CPU seconds."""
    lines = [
        "| task | by | solved / attempts | 95 % | enclosed | actions | CPU s an attempt |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in pooled(rows):
        if row.task.startswith("bag-"):
            n, solved = row.attempts, row.successes
            interval = binomtest(solved, n).proportion_ci(method="wilson")
            enclosed = "-" if row.enclosed is None else str(row.enclosed)
            lines.append(
                f"| {row.task} | `{row.by}` | {solved} / {n} | {100 * interval.low:.0f} to "
                f"{100 * interval.high:.0f} % | {enclosed} | {row.mean_actions:.2f} "
                f"| {row.cpu_s_per_attempt:.1f} |"
            )
    return "\n".join(lines)


def _name(row: Row) -> str:
    return row.by if row.depth is None else f"{row.by}, {row.depth} ahead"


def _compact(rows: list[Row]) -> str:
    """Mean actions, a line a task; solved less than always: the share."""
    names, tasks = (list(dict.fromkeys(of(row) for row in rows)) for of in (_name, _task))
    cells = {}
    for row in rows:
        share = "" if row.successes == row.attempts else f" ({row.successes}/{row.attempts})"
        cells[row.task, _name(row)] = f"{row.mean_actions:.2f} ± {row.actions_error:.2f}{share}"
    lines = [["task", *names], ["---"] * (1 + len(names))]
    lines += [[task, *(cells.get((task, name), "") for name in names)] for task in tasks]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _task(row: Row) -> str:
    return row.task


def _line(row: Row) -> str:
    low, high = row.interval
    shares = row.pierced
    edges = f"{100 * shares['mean']:.2f} / {100 * shares['worst']:.1f} %" if shares else "-"
    return (
        f"| {row.task} | {_name(row)} | {row.successes} / {row.attempts} "
        f"| {100 * low:.1f}-{100 * high:.1f} % | {row.mean_actions:.2f} ± {row.actions_error:.2f} "
        f"| {row.mean_score:.3f} ± {row.score_error:.3f} "
        f"| {row.cpu_s_per_attempt:.3f} | {edges} |"
    )


if __name__ == "__main__":
    main()
