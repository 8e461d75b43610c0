"""How many picks at random take something, by the distance within which they are drawn to things.

    python benchmarks/snapped_picks.py [--out FILE]

25 picks, drawn evenly from the action space, in each of eight starts of three tasks.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from warp_deform.robots.primitive import find_grasp
from warp_deform.worlds import Worlds
from warp_deform.worlds.acting import snapped
from warp_deform.worlds.spaces import action_space

TASKS = ("cable-ring", "fabric-flat", "block-notarget")
WITHIN = (0.0, 0.015, 0.05, 0.1, 0.2, np.inf)
STARTS, PICKS = 8, 25


def rows(task: str) -> list[dict[str, object]]:
    """One row a distance [m]."""
    worlds, rng, space = Worlds(task, STARTS), np.random.default_rng(0), action_space()
    worlds.reset({slot: slot for slot in range(STARTS)})
    took = dict.fromkeys(WITHIN, 0)
    for slot in range(STARTS):
        seen = worlds.episodes[slot].snapshot
        for _ in range(PICKS):
            action = rng.uniform(space.low, space.high)
            for within in WITHIN:
                pick = snapped(action, worlds.task, seen, within)[:3]
                state = seen.objects, seen.particle_q, seen.body_q
                took[within] += find_grasp(pick, *state, worlds.task.primitive) is not None
    return [
        {
            "task": task,
            "snap_mm": "any" if within == np.inf else round(1000 * within),
            "picks": STARTS * PICKS,
            "took": int(count),
        }
        for within, count in took.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/snapped_picks.jsonl"))
    options = parser.parse_args()
    with options.out.open("w") as file:
        for task in TASKS:
            for row in rows(task):
                file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
