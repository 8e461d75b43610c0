"""What a network's grid of actions costs: the demonstrator, its actions rounded to that grid.

    python benchmarks/action_grid.py [--tasks cable-shape ...] [--seeds 200] [--out rows.jsonl]

A network names a pixel of its picture and one of its rotations, so no training makes it more exact
than that. Here the scripted demonstrator plays the same seeds three times: as it is, and with pick
and place moved to the centre of the pixel that holds them, of `paper` (3.125 mm) and of `fast`
(6.25 mm), and the turn between them to the nearest of the task's. What `fast` loses against
`paper` is all that a refinement of its pixels could bring. Printed: episodes solved, mean score [%]
and 1.96 of its standard errors. Rows that --out has are not made again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from learning.models.transporter import PRESETS, TransporterConfig
from warp_deform.collecting.workers import single_threaded
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Task
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SOLVED, Act, EpisodeRun, play, worlds_for

TASKS = ("cable-line-notarget", "cable-shape", "fabric-flat-notarget", "block-notarget")
GRIDS = {
    "none": "exact actions",
    "paper": "rounded to 3.125 mm (`paper`)",
    "fast": "rounded to 6.25 mm (`fast`)",
}
FIRST_SEED = 700_000


@dataclass(frozen=True)
class Row:
    """A task played on a grid; score_error: 1.96 standard errors of mean_score, in [0, 1]."""

    task: str
    grid: str
    episodes: int
    successes: int
    mean_score: float
    score_error: float
    mean_actions: float


def key(row: Row) -> tuple[str, str, int]:
    """What two rows that mean the same have in common."""
    return row.task, row.grid, row.episodes


def rounded(action: np.ndarray, task: Task, config: TransporterConfig) -> np.ndarray:
    """An action (7,) as the network of `config` could have named it."""
    result = action.copy()
    for where in (slice(0, 2), slice(3, 5)):
        pixel = config.to_network(task.grid.to_pixel(action[where]))
        result[where] = task.grid.to_world(config.to_camera(pixel))
    bin_width = 2 * math.pi / task.place_yaws
    result[5] = action[2] + round((action[5] - action[2]) / bin_width) * bin_width
    return result


def on_grid(task: Task, config: TransporterConfig | None) -> Act[float]:
    """The scripted demonstrator, on the grid of `config` where there is one."""
    scripted = demonstrator("scripted")

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[float]]) -> dict[int, np.ndarray | None]:
        actions = dict(scripted(worlds, runs))
        if config is not None:
            for slot, action in actions.items():
                actions[slot] = None if action is None else rounded(action, task, config)
        return actions

    return act


def measure(name: str, grid: str, episodes: int) -> Row:
    """Play `episodes` of a task."""
    task = find_task(name)
    act = on_grid(task, PRESETS.get(grid))
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    runs = [
        run
        for _, run in play(
            worlds_for(name, "ur5"), seeds, act=act, look=lambda w, slot: w.score(slot)
        )
    ]
    scores = np.array([run.rows[-1] if run.rows else 0.0 for run in runs])
    solved = sum(run.ended == SOLVED for run in runs)
    return Row(
        name,
        grid,
        episodes,
        solved,
        float(scores.mean()),
        float(1.96 * scores.std(ddof=1) / math.sqrt(episodes)),
        float(np.mean([len(run.actions) for run in runs])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out and options.out.exists() else []
    rows = {key(row): row for row in (Row(**json.loads(line)) for line in lines)}
    quiet_warp()
    with single_threaded():
        for wanted in itertools.product(options.tasks, GRIDS, (options.seeds,)):
            if wanted not in rows:
                row = rows[wanted] = measure(*wanted)
                if options.out is not None:
                    with options.out.open("a") as file:
                        file.write(json.dumps(asdict(row)) + "\n")
    print(table(list(rows.values())))


def table(rows: Sequence[Row]) -> str:
    """Rows as Markdown, a task a line."""
    lines = ["| task | " + " | ".join(GRIDS.values()) + " |", "|---" * (len(GRIDS) + 1) + "|"]
    for task in dict.fromkeys(row.task for row in rows):
        cells = {
            row.grid: f"{row.successes} / {row.episodes}, "
            f"{100 * row.mean_score:.1f} ± {100 * row.score_error:.1f}"
            for row in rows
            if row.task == task
        }
        lines.append(f"| {task} | " + " | ".join(cells.get(grid, "") for grid in GRIDS) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
