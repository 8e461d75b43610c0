"""Which goals of cable-mask-goal are reached: nearly straight ones, or strongly bent ones.

    python benchmarks/goal_bends.py RUN [--demonstrators D...] [--episodes N] [--out FILE]

The snapshot of RUN that `eval` chose, or its last one, plays N test episodes; those that it has
played are not played again. Demonstrators play the same episodes for the same goals. Goals are
ordered by how far their chain turns: the greatest less the least angle of its tangent, of pieces
of three beads. A line of FILE is a quarter of them and who played; who plays again has new lines.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from learning.evaluation.protocol import Protocol, goals_for, goals_of
from learning.evaluation.snapshot import evaluate_snapshot
from learning.runs.folder import RunFolder
from warp_deform.episodes import Goal
from warp_deform.planning.demonstrators import DEMONSTRATORS, demonstrator
from warp_deform.quiet import quiet_warp
from warp_deform.support.revision import running_revision
from warp_deform.support.whole_file import whole_file
from warp_deform.worlds.loop import SOLVED, play
from warp_deform.worlds.worlds import Worlds

TASK = "cable-mask-goal"
_BEADS = 3
_QUARTERS = 4


def turn_deg(points: np.ndarray) -> float:
    """How far a chain of beads (n, 2 or more) turns [deg]; 0 for a straight one."""
    x, y = np.diff(points[::_BEADS, :2], axis=0).T
    angles = np.unwrap(np.arctan2(y, x))
    return float(np.degrees(np.ptp(angles)))


def quarters(turns: Mapping[int, float], solved: Mapping[int, bool]) -> Iterator[dict[str, Any]]:
    """Of every quarter of the seeds, by the turns of their goals, how many are solved."""
    ordered = sorted(turns, key=lambda seed: turns[seed])
    for number, part in enumerate(np.array_split(ordered, _QUARTERS), start=1):
        yield {
            "quarter": number,
            "least_deg": round(turns[int(part[0])], 1),
            "most_deg": round(turns[int(part[-1])], 1),
            "n_success": sum(solved[int(seed)] for seed in part),
            "n_episodes": len(part),
        }


def demonstrated(name: str, goals: Mapping[int, Goal]) -> dict[int, bool]:
    """Which episodes a demonstrator solves for these goals, by seed."""
    runs = play(
        Worlds(TASK), list(goals), act=demonstrator(name), look=_nothing, goals=goals.__getitem__
    )
    return {run.seed: run.ended == SOLVED for _, run in runs}


def keep(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows to a file, in place of what it had by the same players."""
    there = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    players = {row["by"] for row in rows}
    kept = [row for row in there if row["by"] not in players]
    with whole_file(path) as file:
        file.write_text("".join(json.dumps(row) + "\n" for row in [*kept, *rows]))


def _nothing(worlds: Worlds, slot: int) -> None:
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--demonstrators", nargs="*", choices=DEMONSTRATORS, default=["scripted"])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    quiet_warp()
    run, protocol = RunFolder(arguments.run), Protocol(split="test", episodes=arguments.episodes)
    task = run.read_settings()["agent"]["task"]
    if task != TASK:
        parser.error(f"{run.path} is a run of {task}; give one of {TASK}")
    folder = goals_for(run, TASK, protocol)
    assert folder is not None  # the task is goal-conditioned
    goals = goals_of(folder, protocol, protocol.seeds)
    turns = {seed: turn_deg(np.asarray(goal.targets)) for seed, goal in goals.items()}
    step = int(run.chosen_snapshot().stem.rpartition("_")[2])
    played = evaluate_snapshot(run, step, protocol).episodes
    solved = {arguments.run.name: {each.seed: each.success for each in played}}
    for name in arguments.demonstrators:
        solved[name] = demonstrated(name, goals)
    commit = running_revision().commit
    rows = [
        {"by": who, **row, "commit": commit}
        for who, outcome in solved.items()
        for row in quarters(turns, outcome)
    ]
    for each in rows:
        print(json.dumps(each))
    if arguments.out is not None:
        keep(arguments.out, rows)


if __name__ == "__main__":
    main()
