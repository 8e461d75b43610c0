"""What peers cost at equal error: a search over their settings, and a table and pictures of it.

    python benchmarks/peers.py search [--scenes cable heap] [--engines mujoco]
    python benchmarks/peers.py time [--scenes cable] [--rounds 5]
    python benchmarks/peers.py between [--scenes cable]
    python benchmarks/peers.py report [--pictures docs/images/peers.webp]

`search` tries the settings of `peers_settings.py` and appends a row for each to
`results/peers.jsonl`: its error against the engine's own fine solution, its faults, its cost. What
has a row is not tried again. `time` takes from each engine what costs least at its error, and times
all of them in turns, in one process, so that ratios compare neighbours in time; its rows keep the
least of several rounds. `between` measures how far the fine solutions of the engines are from ours:
what they would not agree on at any cost. `report` prints the tables, and draws error over cost.

Costs are milliseconds of process CPU time per simulated second and world, on one thread.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import peers_report
from peers_measures import believable, measure_play
from peers_play import fine_tracks, play, starts_of
from peers_rows import RESULTS, append, described, key, read
from peers_settings import ENGINES, SCENES, fine, grid, has_fine, settings_of

from warp_deform.quiet import quiet_warp

MOST = {"cable": 6.0, "heap": 6.0, "ring": 6.0, "block": 3.0, "tower": 3.0}
"""CPU seconds after which a setting is given up: it is many times dearer than what wins."""
MOST_SOFT = 60.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("search", "time", "between", "report"):
        each = verbs.add_parser(verb)
        each.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
        each.add_argument("--results", type=Path, default=RESULTS)
        if verb == "search":
            each.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
        if verb == "time":
            each.add_argument("--rounds", type=int, default=5)
        if verb == "report":
            each.add_argument("--pictures", type=Path, help="a picture with all scenes")
    options = parser.parse_args()
    quiet_warp()
    if options.verb == "search":
        for scene in options.scenes:
            for engine in options.engines:
                search(engine, scene, options.results)
    elif options.verb == "time":
        for scene in options.scenes:
            time_front(scene, options.results, options.rounds)
    elif options.verb == "between":
        for scene in options.scenes:
            between(scene, options.results)
    else:
        rows = [row for row in read(options.results) if row["scene"] in options.scenes]
        print(peers_report.table(rows), peers_report.between_table(rows), sep="\n\n")
        if options.pictures:
            peers_report.draw(rows, options.pictures)


def search(engine: str, scene: str, results: Path) -> None:
    """Try what has no row yet."""
    known = {key(row) for row in read(results) if row["kind"] == "search"}
    reference, starts = None, starts_of(scene)
    for settings in grid(engine, scene):
        row = {"kind": "search", **described(engine, scene, settings)}
        if key(row) in known:
            continue
        if reference is None and has_fine(engine, scene):
            reference = fine_tracks(engine, scene)
        tracks, cost = play(engine, scene, settings, most=MOST.get(scene, MOST_SOFT))
        if engine == "ours":
            cost = min(play(engine, scene, settings, record=False)[1] for _ in range(2))
        row |= {"starts": len(starts), "ms": cost}
        row |= {"errors": measure_play(starts, tracks, reference)}
        append(row, results)
        print(engine, scene, settings, f"{cost:.3g} ms", row["errors"], flush=True)


def time_front(scene: str, results: Path, rounds: int) -> None:
    """Time what is best at its error, of all engines in turns, on the first start.

    Errors are those of the search. Worlds in lanes each have a start of their own.
    """
    rows = [row for row in read(results) if row["kind"] == "search" and row["scene"] == scene]
    chosen = [row for engine in ENGINES for row in peers_report.front(rows, engine)]
    least: dict[str, float] = {}
    for _ in range(rounds):
        for row in chosen:
            settings = settings_of(row["engine"], scene, row["settings"])
            _, cost = play(row["engine"], scene, settings, record=False, count=1)
            least[key(row)] = min(cost, least.get(key(row), cost))
    for row in chosen:
        settings = settings_of(row["engine"], scene, row["settings"])
        timed = {"kind": "time", **described(row["engine"], scene, settings)}
        timed |= {"starts": 1, "rounds": rounds, "ms": least[key(row)]}
        append(timed | {"errors": row["errors"], "believable": believable(row)}, results)
        print(row["engine"], scene, settings, f"{least[key(row)]:.3g} ms", flush=True)


def between(scene: str, results: Path) -> None:
    """Compare the fine solution of each peer with ours."""
    ours = fine_tracks("ours", scene)
    for engine in ENGINES:
        if engine == "ours" or not grid(engine, scene) or not has_fine(engine, scene):
            continue
        row = {"kind": "between", **described(engine, scene, fine(engine, scene))}
        row |= {"errors": measure_play(starts_of(scene), fine_tracks(engine, scene), ours)}
        append(row, results)
        print(engine, scene, row["errors"], flush=True)


if __name__ == "__main__":
    main()
