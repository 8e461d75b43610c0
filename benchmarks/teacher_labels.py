"""How far a teacher's labels lie from what a trained policy does in the states that it comes to.

    python benchmarks/teacher_labels.py TASK RUN [--teacher mpc] [--episodes 12] [--out FILE]

The policy plays seeds from 9,000 up, and the teacher is asked in every state, as by
`warp-deform correct`. A policy cannot do what no picture shows, so labels that lie far away in most
states of a policy that solves its task are a sign that the teacher goes by something hidden. A row
has medians over states; rows are appended, with the commit that measured.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from learning.evaluation.play import acting
from learning.evaluation.protocol import Protocol
from learning.policy.policy import load_policy
from warp_deform.collecting.recording import observe
from warp_deform.planning.demonstrators import DEMONSTRATORS, demonstrator
from warp_deform.support.revision import running_revision
from warp_deform.tasks.task import Action
from warp_deform.worlds.loop import SOLVED, EpisodeRun, play, worlds_for
from warp_deform.worlds.worlds import Worlds

FIRST_SEED = 9_000


def main() -> None:
    """Measure one policy."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("task")
    parser.add_argument("run", type=Path, help="folder of a run or a policy")
    parser.add_argument("--teacher", choices=tuple(DEMONSTRATORS), default="mpc")
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--out", type=Path, help="file of rows, one is added")
    options = parser.parse_args()
    row = measured(options.task, options.run, options.teacher, options.episodes)
    print(json.dumps(row))
    if options.out is not None:
        with options.out.open("a") as file:
            file.write(json.dumps(row) + "\n")


def measured(task: str, run: Path, teacher: str, episodes: int) -> dict[str, Any]:
    """A row: medians of the distances [mm] between picks and between places."""
    policy, worlds, teach = load_policy(run), worlds_for(task, "ur5"), demonstrator(teacher)
    chosen = acting(policy, Protocol(split="test", episodes=1))
    apart: list[tuple[float, float]] = []

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> Mapping[int, Action | None]:
        wanted, own = teach(worlds, runs), chosen(worlds, runs)
        for slot, label in wanted.items():
            action = own.get(slot)
            if label is not None and action is not None:
                offset = 1e3 * (np.asarray(label) - np.asarray(action))
                apart.append((float(np.hypot(*offset[:2])), float(np.hypot(*offset[3:5]))))
        return own

    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    ends = [each.ended for _, each in play(worlds, seeds, act=act, look=observe)]
    if not apart:
        raise SystemExit(f"{teacher} has nothing to say of {task}; choose another --teacher")
    picks, places = np.median(apart, axis=0)
    return {
        "task": task,
        "policy": run.name,
        "teacher": teacher,
        "episodes": episodes,
        "solved": sum(end == SOLVED for end in ends),
        "states": len(apart),
        "pick_mm": float(picks),
        "place_mm": float(places),
        "commit": running_revision().commit[:7],
    }


if __name__ == "__main__":
    main()
