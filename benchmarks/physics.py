"""Cost of the physics: this package alone and in lanes, against PyBullet and stock Newton solvers.

    python benchmarks/physics.py [--scenes cable ring] [--quick] [--growth FILE.png] [--json]

Prints one row a scene, in milliseconds of process CPU time per simulated second (1000 would be real
time). Every peer is timed in the same process run as ours, so a ratio compares neighbours in time.
PyBullet runs at the original environment's settings; a Newton solver runs at the cheapest settings
at which the median start stretches a link by 1 to 3 %, a fold a sheet by a few percent.
`warp_deform.peers` says what each omits. Fabrics and bags take a peer minutes.

`--growth` plots instead how the cost grows with the vertices of a fabric, and how that of one world
falls with the number of worlds that share the lanes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from warp_deform.bench import SCENES, run
from warp_deform.errors import InputError
from warp_deform.quiet import quiet_warp
from warp_deform.xpbd.lanes.algebra import LANES as LANE_COUNTS

PEERS = {
    "cable": ("pybullet", "newton-vbd", "newton-xpbd"),
    "heap": ("pybullet", "newton-vbd", "newton-xpbd"),
    "ring": ("pybullet", "newton-vbd", "newton-xpbd"),
    "block": ("pybullet", "newton-xpbd"),
    "cloth10": ("pybullet", "newton-vbd"),
    "cloth10-edges": ("pybullet",),
    "cloth25": ("pybullet", "newton-vbd"),
    "cloth25-edges": ("pybullet",),
    "cloth50": ("pybullet",),
    "cloth50-edges": (),
    "bag": ("pybullet", "newton-vbd"),
    "bag-cube": ("pybullet", "newton-vbd"),
}
LANES = 8
WORLDS = 64
GROWTH_SHEETS = {"cloth10": 10, "cloth25": 25, "cloth50": 50}  # rows
GROWTH_WORLDS = (1, 2, 4, 8, 16)
GROWTH_SCENES = ("cable", "cloth10", "cloth25")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    known = [name for name in PEERS if name in SCENES]
    parser.add_argument("--scenes", nargs="+", choices=known, default=known)
    parser.add_argument(
        "--seconds",
        type=float,
        help="simulated time of a repeat [s]; 1, or a fabric's whole play, where left out",
    )
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--growth", metavar="FILE.png", type=Path, help="plot how costs grow")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    options = parser.parse_args()
    if options.quick:
        options.seconds, options.repeats = 0.25, 2
    quiet_warp()
    if options.growth is not None:
        growth = measure_growth(repeats=options.repeats, quick=options.quick)
        plot_growth(growth, options.growth)
        print(json.dumps(growth) if options.json else growth_table(growth))
        return

    scenes = [
        time_scene(name, seconds=options.seconds, repeats=options.repeats)
        for name in options.scenes
    ]
    report = {
        "machine": machine(),
        "lanes": LANES,
        "worlds": WORLDS,
        "seconds": options.seconds,
        "repeats": options.repeats,
        "scenes": scenes,
    }
    print(json.dumps(report) if options.json else tables(report))


def time_scene(
    name: str, *, seconds: float | None, repeats: int, peers: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """One scene with each of `peers` (None: all of its own), or alone where it has none.

    Ours is timed again beside each peer: the row shows the median of those, the ratios stay as
    measured. A peer that is not installed becomes a line of text in `absent`.
    """
    runs: dict[str, dict[str, Any]] = {}
    absent: dict[str, str] = {}
    for peer in (PEERS[name] if peers is None else peers) or (None,):
        try:
            result = run(
                scene=name, peer=peer, lanes=LANES, worlds=WORLDS, seconds=seconds, repeats=repeats
            )
        except InputError as error:
            if peer is None:
                raise
            absent[peer] = str(error)
        else:
            runs[peer or "alone"] = result
    if not runs:
        runs["alone"] = run(
            scene=name, peer=None, lanes=LANES, worlds=WORLDS, seconds=seconds, repeats=repeats
        )
    ours = {
        key: statistics.median(result[key] for result in runs.values())
        for key, value in next(iter(runs.values())).items()
        if key.startswith(("ms_per_sim_second", "stretch")) and isinstance(value, float)
    }
    first = next(iter(runs.values()))
    fixed = {key: first[key] for key in ("scene", "dt", "substeps", "particles", "worlds")}
    timed = {
        peer: {key: value for key, value in result.items() if key.startswith(("peer_", "ratio"))}
        for peer, result in runs.items()
        if peer != "alone"
    }
    return {**fixed, **ours, "peers": timed, "absent": absent}


def measure_growth(*, repeats: int, quick: bool) -> dict[str, Any]:
    """Cost against the rows of a fabric, beside PyBullet's, and against the worlds in lanes.

    Every world has a lane of its own; two worlds leave two lanes of four empty. `quick` leaves
    out what takes longest.
    """
    sheets = [
        name for name in GROWTH_SHEETS if name in SCENES and not (quick and name != "cloth10")
    ]
    rows = []
    for name in sheets:
        timed = time_scene(name, seconds=0.1 if quick else None, repeats=1, peers=("pybullet",))
        peer = timed["peers"].get("pybullet", {})
        rows.append(
            {
                "rows": GROWTH_SHEETS[name],
                "ms_per_sim_second": timed["ms_per_sim_second"],
                "ms_per_sim_second_lanes": timed["ms_per_sim_second_lanes"],
                "pybullet": peer.get("peer_ms_per_sim_second"),
            }
        )
    lanes: dict[str, list[float]] = {}
    for name in GROWTH_SCENES[:2] if quick else GROWTH_SCENES:
        lanes[name] = [
            run(
                scene=name,
                lanes=min(lanes for lanes in LANE_COUNTS if lanes >= count),
                worlds=count,
                repeats=min(repeats, 3),
            )["ms_per_sim_second_lanes"]
            for count in GROWTH_WORLDS
        ]
    return {"machine": machine(), "sheets": rows, "worlds": GROWTH_WORLDS, "lanes": lanes}


def growth_table(growth: dict[str, Any]) -> str:
    """What `measure_growth` found as two Markdown tables, in CPU ms per simulated second."""
    lines = [", ".join(f"{key} {value}" for key, value in growth["machine"].items()), ""]
    lines += [
        f"| rows | one world | {LANES} lanes, per world | pybullet | pybullet / one world |",
        "|---|---|---|---|---|",
    ]
    for row in growth["sheets"]:
        ours, theirs = row["ms_per_sim_second"], row["pybullet"]
        lines.append(
            f"| {row['rows']} | {_cell(ours)} | {_cell(row['ms_per_sim_second_lanes'])} "
            f"| {_cell(theirs)} | {_cell(theirs and theirs / ours, '.1f')} |"
        )
    lines += ["", f"| worlds in lanes | {' | '.join(map(str, growth['worlds']))} |"]
    lines += ["|---" * (1 + len(growth["worlds"])) + "|"]
    for name, times in growth["lanes"].items():
        lines.append(f"| {name}, per world | {' | '.join(map(_cell, times))} |")
    return "\n".join(lines)


def plot_growth(growth: dict[str, Any], path: Path) -> None:
    """Write both relations to the picture `path`, each on logarithmic axes."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.5, 4), layout="constrained")
    sizes = [row["rows"] ** 2 for row in growth["sheets"]]
    for key, label in (
        ("pybullet", "PyBullet"),
        ("ms_per_sim_second", "one world"),
        ("ms_per_sim_second_lanes", f"{LANES} lanes, per world"),
    ):
        values = [np.nan if row[key] is None else row[key] for row in growth["sheets"]]
        left.loglog(sizes, values, marker="o", label=label)
    left.set_xlabel("vertices of a fabric")
    for name, times in growth["lanes"].items():
        right.loglog(growth["worlds"], times, marker="o", label=name)
    right.set_xlabel("worlds in lanes")
    right.set_xticks(growth["worlds"], [str(count) for count in growth["worlds"]])
    for axes in (left, right):
        axes.set_ylabel("CPU ms per simulated second and world")
        axes.grid(which="both", alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def tables(report: dict[str, Any]) -> str:
    """The report as two Markdown tables, ours and the peers'."""
    lines = [", ".join(f"{key} {value}" for key, value in report["machine"].items()), ""]
    lines += [
        f"| scene | particles | dt [ms] | substeps | ours, one world p50 / p95 "
        f"| ours, {report['lanes']} lanes, per world p50 / p95 | worlds | stretch |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in report["scenes"]:
        lines.append(
            f"| {row['scene']} | {row['particles']} | {1e3 * row['dt']:.2f} | {row['substeps']} "
            f"| {_pair(row, 'ms_per_sim_second')} | {_pair(row, 'ms_per_sim_second_lanes')} "
            f"| {row['worlds']} | {row['stretch']:.3f} |"
        )
    lines += [
        "",
        "| scene | peer | ms/s p50 / p95 | at rest | steps per s | stretch "
        "| peer / ours | peer / ours in lanes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    notes: dict[str, None] = {}  # each once, in order
    for row in report["scenes"]:
        for name, peer in row["peers"].items():
            lines.append(
                f"| {row['scene']} | {name} | {_pair(peer, 'peer_ms_per_sim_second')} "
                f"| {_cell(peer.get('peer_rest_ms_per_sim_second'))} "
                f"| {_cell(peer.get('peer_hz'), '.0f')} | {_cell(peer.get('peer_stretch'), '.3f')} "
                f"| {peer['ratio']:.1f} | {peer['ratio_lanes']:.0f} |"
            )
            notes |= {f"{name}: {peer['peer_note']}": None} if peer.get("peer_note") else {}
        notes |= {f"{name}: {text}": None for name, text in row["absent"].items()}
    lines += ["", *notes]
    return "\n".join(lines).rstrip()


def _pair(row: dict[str, Any], key: str) -> str:
    return f"{_cell(row.get(key))} / {_cell(row.get(key + '_p95'))}"


def _cell(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)


def machine() -> dict[str, str]:
    """What the figures depend on: processor, cores, Python and the engines' versions."""
    described = {
        "cpu": _processor(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
    }
    for name in ("warp-deform", "warp-lang", "newton", "pybullet"):
        try:
            described[name] = version(name)
        except PackageNotFoundError:
            described[name] = "not installed"
    return described


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
