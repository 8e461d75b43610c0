"""How hard a task is with other materials or starts: success and actions of a demonstrator.

    python benchmarks/hardness.py fabric-flat --set overshoot=0.03 fabric.structural_stiffness=100
    python benchmarks/hardness.py bag-items-1 --set pushes=4 bag.ring_stiffness=60 --out F
    python benchmarks/hardness.py cable-mask-goal --misplace 4

Every --set changes an attribute of the task, one of its frozen configs after a dot; none measures
the task as it is. Several tasks get the same changes. With --misplace, every place is off by a
Gaussian in x and in y: how exactly a policy has to place. Plays whole episodes, eight side by
side, on training seeds from 20,000 up, and prints a line a task: the success, the actions of the
successes, how the starts score, and for bags how far they are open at the start and what the
actions were for.
With --out, rows are added to a file of JSON lines, and settings that are in it are not measured
again.
"""

from __future__ import annotations

import argparse
import ast
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.collecting.recording import observe
from warp_deform.collecting.workers import single_threaded
from warp_deform.planning.demonstrators import DEMONSTRATORS, demonstrator
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.bag_opening import BagTask
from warp_deform.tasks.registry import FURTHER_TASKS, TASKS
from warp_deform.tasks.task import Action, Task
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SLOTS, SOLVED, Act, EpisodeRun, play

FIRST = 20_000
"""First of the training seeds on which settings are chosen."""


@dataclass(frozen=True)
class Row:
    """A task with some settings, played by a demonstrator."""

    task: str
    by: str
    settings: dict[str, Any]
    changed: str
    """The same in words."""
    first_seed: int
    attempts: int
    successes: int
    mean_actions_solved: float | None
    deviation_solved: float | None
    """Standard deviation of the actions of the successes."""
    median_actions_solved: float | None
    start_score: float
    """Median of the score at the start."""
    enclosed: int | None
    opening: float | None
    """Median share of the circle that a bag's beads span at the start."""
    stages_solved: list[float] | None
    """Mean actions of each stage in the successes; None where a task has one stage."""
    ends: dict[str, int]
    """How episodes ended."""
    misplace_mm: float = 0.0
    """Standard deviation of the places' errors in x and in y [mm]."""


def changed(name: str, settings: dict[str, Any]) -> Task:
    """A task by its name, with attributes, or fields of its configs, changed."""
    kind = (TASKS | FURTHER_TASKS)[name]
    values: dict[str, Any] = {}
    for key, value in settings.items():
        first, _, rest = key.partition(".")
        old = values.get(first, getattr(kind, first))  # a wrong name is an AttributeError
        values[first] = replace(old, **{rest: value}) if rest else value
    return type(kind.__name__, (kind,), values)()


def words(settings: dict[str, Any]) -> str:
    """Settings as the table prints them.

    Examples:
        >>> words({"bag.ring_stiffness": 120.0, "pushes": 0})
        'bag.ring_stiffness=120; pushes=0'
    """
    texts = {n: f"{v:g}" if isinstance(v, int | float) else str(v) for n, v in settings.items()}
    return "; ".join(f"{name}={text}" for name, text in texts.items()) or "nothing"


def misplacing(act: Act[Any], misplace_mm: float) -> Act[Any]:
    """Who acts as `act`, but places beside where it meant to, within view."""

    def beside(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, Action | None]:
        actions = act(worlds, runs)
        for slot, action in actions.items():
            if action is not None:
                error = runs[slot].rng.normal(0.0, misplace_mm / 1000, 2)
                moved = action.copy()
                moved[3:5] = worlds.task.grid.in_view(action[3:5] + error)
                actions[slot] = moved
        return actions

    return beside if misplace_mm else act


def measure(
    name: str, by: str, settings: dict[str, Any], first: int, count: int, misplace_mm: float = 0.0
) -> Row:
    """Play every seed once."""
    with single_threaded():
        task = changed(name, settings)
        worlds = Worlds(task, SLOTS, lanes=SLOTS)
        scores, openings, runs, enclosed = [], [], [], []

        def look(worlds: Worlds, slot: int) -> object:
            episode = worlds.episodes[slot]
            if not episode.history:
                scores.append(worlds.score(slot))
                if isinstance(task, BagTask):
                    openings.append(task.opening(episode.snapshot))
            return observe(worlds, slot)

        act = misplacing(demonstrator(by), misplace_mm)
        for slot, run in play(worlds, range(first, first + count), act=act, look=look):
            runs.append(run)
            inside = worlds.enclosed(slot) if run.rows else None
            enclosed.append(None if inside is None else inside and run.ended == SOLVED)
    solved = [run for run in runs if run.ended == SOLVED]
    actions = np.array([len(run.actions) for run in solved], dtype=float)
    stages = None
    if solved and len(task.stages) > 1:
        used = [[task.stage_of(float(a[6])) for a in run.actions] for run in solved]
        stages = [float(np.mean([row.count(stage) for row in used])) for stage in task.stages]
    ends = [str(run.ended).split(" after ")[0].split(" in ")[0] for run in runs]
    return Row(
        task=name,
        by=by,
        settings=settings,
        changed=words(settings),
        first_seed=first,
        attempts=count,
        successes=len(solved),
        mean_actions_solved=float(actions.mean()) if solved else None,
        deviation_solved=float(actions.std()) if solved else None,
        median_actions_solved=float(np.median(actions)) if solved else None,
        start_score=float(np.median(scores)),
        enclosed=None if None in enclosed else sum(map(bool, enclosed)),
        opening=float(np.median(openings)) if openings else None,
        stages_solved=stages,
        ends={end: ends.count(end) for end in sorted(set(ends))},
        misplace_mm=misplace_mm,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("tasks", nargs="*", choices=[*TASKS, *FURTHER_TASKS])
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", dest="settings")
    parser.add_argument("--by", default="scripted", choices=list(DEMONSTRATORS))
    parser.add_argument("--seeds", type=int, default=48)
    parser.add_argument("--first", type=int, default=FIRST, help="first seed")
    parser.add_argument("--misplace", type=float, default=0.0, metavar="MM")
    parser.add_argument("--out", type=Path, help="file of JSON lines to which rows are added")
    options = parser.parse_args()
    if not 0 <= options.misplace < np.inf:
        parser.error(f"--misplace is {options.misplace}; give 0 mm or more")
    quiet_warp()
    pairs = (pair.partition("=") for pair in options.settings)
    settings = {name: ast.literal_eval(value) for name, _, value in pairs}
    known = []
    if options.out and options.out.exists():
        known = [Row(**json.loads(line)) for line in options.out.read_text().splitlines()]
    for name in options.tasks:
        key = (name, options.by, settings, options.first, options.seeds, options.misplace)
        old = [
            r
            for r in known
            if (r.task, r.by, r.settings, r.first_seed, r.attempts, r.misplace_mm) == key
        ]
        row = old[0] if old else measure(*key)
        print(_line(row), flush=True)
        if options.out and not old:
            with options.out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")


def _line(row: Row) -> str:
    rate = 100 * row.successes / row.attempts
    what = f"{row.changed}, places {row.misplace_mm:g} mm off" if row.misplace_mm else row.changed
    line = f"{row.task} {row.by} {what}: {row.successes}/{row.attempts} = {rate:.1f} %"
    if row.mean_actions_solved is not None:
        line += f", {row.mean_actions_solved:.2f} +- {row.deviation_solved:.2f} actions"
        line += f" (median {row.median_actions_solved:g})"
    line += f", start {row.start_score:.3f}"
    if row.opening is not None:
        line += f", opening {row.opening:.2f}, enclosed {row.enclosed}"
    if row.stages_solved is not None:
        line += ", stages " + " ".join(f"{n:.2f}" for n in row.stages_solved)
    return f"{line}, {row.ends}"


if __name__ == "__main__":
    main()
