"""Cost of the physics: this package alone and in lanes, against PyBullet and stock Newton solvers.

    python benchmarks/physics.py [--scenes cable ring] [--quick] [--json]

Prints one row a scene, in milliseconds of process CPU time per simulated second (1000 would be real
time). Every peer is timed in the same process run as ours, so a ratio compares neighbours in time.
PyBullet runs at the original environment's settings; a Newton solver runs at the cheapest settings
at which the median start stretches a link by 1 to 3 %. `warp_deform.peers` says what each omits.
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

from warp_deform.bench import run
from warp_deform.errors import InputError
from warp_deform.quiet import quiet_warp

PEERS = {
    "cable": ("pybullet", "newton-vbd", "newton-xpbd"),
    "heap": ("pybullet", "newton-vbd", "newton-xpbd"),
    "ring": ("pybullet", "newton-vbd", "newton-xpbd"),
    "block": ("pybullet", "newton-xpbd"),
    "cloth10": (),
    "cloth25": (),
}
LANES = 8
WORLDS = 64


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("--seconds", type=float, default=1.0, help="simulated time of a repeat [s]")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    options = parser.parse_args()
    if options.quick:
        options.seconds, options.repeats = 0.25, 2
    quiet_warp()

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


def time_scene(name: str, *, seconds: float, repeats: int) -> dict[str, Any]:
    """One scene with each of its peers, or alone where it has none.

    Ours is timed again beside each peer: the row shows the median of those, the ratios stay as
    measured. A peer that is not installed becomes a line of text in `absent`.
    """
    runs: dict[str, dict[str, Any]] = {}
    absent: dict[str, str] = {}
    for peer in PEERS[name] or (None,):
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
    fixed = {key: first[key] for key in ("scene", "dt", "substeps", "particles")}
    peers = {
        peer: {key: value for key, value in result.items() if key.startswith(("peer_", "ratio"))}
        for peer, result in runs.items()
        if peer != "alone"
    }
    return {**fixed, **ours, "peers": peers, "absent": absent}


def tables(report: dict[str, Any]) -> str:
    """The report as two Markdown tables, ours and the peers'."""
    lines = [", ".join(f"{key} {value}" for key, value in report["machine"].items()), ""]
    lines += [
        f"| scene | particles | dt [ms] | substeps | ours, one world p50 / p95 "
        f"| ours, {report['lanes']} lanes, per world of {report['worlds']} p50 / p95 | stretch |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in report["scenes"]:
        lines.append(
            f"| {row['scene']} | {row['particles']} | {1e3 * row['dt']:.2f} | {row['substeps']} "
            f"| {_pair(row, 'ms_per_sim_second')} | {_pair(row, 'ms_per_sim_second_lanes')} "
            f"| {row['stretch']:.3f} |"
        )
    lines += [
        "",
        "| scene | peer | ms/s p50 / p95 | at rest | steps per s | stretch "
        "| peer / ours | peer / ours in lanes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    notes: dict[str, str] = {}
    for row in report["scenes"]:
        for name, peer in row["peers"].items():
            lines.append(
                f"| {row['scene']} | {name} | {_pair(peer, 'peer_ms_per_sim_second')} "
                f"| {_cell(peer.get('peer_rest_ms_per_sim_second'))} "
                f"| {_cell(peer.get('peer_hz'), '.0f')} | {_cell(peer.get('peer_stretch'), '.3f')} "
                f"| {peer['ratio']:.1f} | {peer['ratio_lanes']:.0f} |"
            )
            notes |= {name: peer["peer_note"]} if peer.get("peer_note") else {}
        notes |= row["absent"]
    lines += ["", *(f"{name}: {text}" for name, text in notes.items())]
    return "\n".join(lines).rstrip()


def _pair(row: dict[str, Any], key: str) -> str:
    return f"{_cell(row.get(key))} / {_cell(row.get(key + '_p95'))}"


def _cell(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)


def machine() -> dict[str, str]:
    """What the figures depend on: processor, cores, Python and the engines' versions."""
    found = {"cpu": _processor(), "cores": str(os.cpu_count()), "python": platform.python_version()}
    for name in ("warp-deform", "warp-lang", "newton", "pybullet"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
