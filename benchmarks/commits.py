"""Cost of the physics in two source trees, play by play in turns: is the newer one slower?

    git worktree add OLDER 6ae8832
    python benchmarks/commits.py OLDER . [--scenes cable heap] [--rounds 15] [--json]

A figure taken in one tree and then in the other says how the machine's clock drifted in between.
Here each tree has a worker process that keeps its solver, and the two play the same start one
after the other, so that a pair of plays lies a fraction of a second apart. Printed are the lowest
costs [process CPU ms per simulated second and world] and the median of the pairs' ratios, newer
over older, with its quartiles. Scenes and plays are those of `warp-deform bench`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

RIGID_SCENES = ("cable", "heap", "ring", "block")
SOFT_SCENES = ("cloth10", "cloth10-edges", "cloth25", "cloth25-edges", "bag", "bag-cube")
LANES = 8
WORLDS = {**dict.fromkeys(RIGID_SCENES, 64), **dict.fromkeys(SOFT_SCENES, 8)}
"""Worlds that share the lanes, by scene."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("older", type=Path, help="source tree that has the older warp_deform")
    parser.add_argument("newer", type=Path, help="source tree that has the newer one")
    parser.add_argument("--scenes", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--rounds", type=int, default=15, help="pairs of plays a scene")
    parser.add_argument("--json", action="store_true", help="print one JSON object a row")
    args = parser.parse_args()
    for tree in (args.older, args.newer):
        if not (tree / "warp_deform" / "bench").is_dir():
            parser.error(f"{tree} has no warp_deform/bench; name the root of a source tree")
    if args.rounds < 1:
        parser.error(f"--rounds must be at least 1, got {args.rounds}")
    for scene in args.scenes:
        for row in compare(args.older, args.newer, scene, args.rounds):
            print(json.dumps(row) if args.json else line(row), flush=True)


def compare(older: Path, newer: Path, scene: str, rounds: int) -> list[dict[str, Any]]:
    """One row for a lone world and one for worlds in lanes: of the play, and of its rest."""
    workers = [_start(tree, scene) for tree in (older, newer)]
    try:
        plays: dict[str, list[list[list[float]]]] = {"alone": [], "lanes": []}
        for k in range(-1, rounds):  # one round more, uncounted: the first play warms the caches
            for how, pairs in plays.items():
                turn = workers if k % 2 else workers[::-1]  # who goes first takes turns as well
                costs = {id(worker): _ask(worker, how, k + 1) for worker in turn}
                if k >= 0:
                    pairs.append([costs[id(worker)] for worker in workers])
    finally:
        for worker in workers:
            worker.terminate()
            worker.wait()
    rows = []
    for how, pairs in plays.items():
        costs = np.array(pairs)  # (rounds, trees, play and rest) [ms a simulated second and world]
        for kind, cost in zip(("play", "rest"), costs.transpose(2, 0, 1), strict=True):
            low, middle, high = np.percentile(cost[:, 1] / cost[:, 0], (25, 50, 75))
            rows.append(
                {
                    "scene": scene,
                    "how": how,
                    "part": kind,
                    "older_ms": float(cost[:, 0].min()),
                    "newer_ms": float(cost[:, 1].min()),
                    "ratio": float(middle),
                    "ratio_quartiles": [float(low), float(high)],
                    "ratio_of_lowest": float(cost[:, 1].min() / cost[:, 0].min()),
                    "rounds": rounds,
                }
            )
    return rows


def line(row: dict[str, Any]) -> str:
    low, high = row["ratio_quartiles"]
    return (
        f"{row['scene']:14} {row['how']:5} {row['part']:4} {row['older_ms']:9.3f} ->"
        f" {row['newer_ms']:9.3f} ms  ratio {row['ratio']:.2f} ({low:.2f} to {high:.2f}),"
        f" of the lowest {row['ratio_of_lowest']:.2f}"
    )


def _start(tree: Path, scene: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(tree.resolve()), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", scene]
    return subprocess.Popen(
        command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def _ask(worker: subprocess.Popen[str], how: str, seed: int) -> list[float]:
    assert worker.stdin is not None and worker.stdout is not None
    with contextlib.suppress(BrokenPipeError):  # it has ended, and then gives no answer
        print(how, seed, file=worker.stdin, flush=True)
    answer = worker.stdout.readline()
    if not answer:
        raise SystemExit(f"a worker ended with code {worker.wait()}; its error stands above")
    return json.loads(answer)


def _serve(scene: str) -> None:
    """Play `scene` whenever asked, with the warp_deform that PYTHONPATH names."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints must not be taken for an answer

    from warp_deform import bench
    from warp_deform.bench import bag, cloth, rigid
    from warp_deform.quiet import quiet_warp

    tree = Path(os.environ["PYTHONPATH"])
    if not Path(bench.__file__).resolve().is_relative_to(tree):
        sys.exit(f"{bench.__file__} was imported, not what {tree} has")
    quiet_warp()
    caught: dict[str, Any] = {}

    def catch(scene: str, build: Any, play: Any, **sizes: Any) -> dict[str, Any]:
        caught.update(build=build, play=play)
        return {}

    for module in (bag, cloth, rigid):
        module.time_worlds = catch
    bench.run(scene=scene)
    worlds = WORLDS[scene]
    solvers = {"alone": caught["build"](1, 1), "lanes": caught["build"](worlds, LANES)}
    for question in sys.stdin:
        how, seed = question.split()
        seeds = [int(seed)] if how == "alone" else list(range(worlds))
        played = caught["play"](solvers[how], seeds)
        cost = played.cpu / played.seconds, played.rest_cpu / played.rest_seconds
        print(json.dumps([1e3 * value / len(seeds) for value in cost]), file=answers, flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        _serve(sys.argv[2])
    else:
        main()
