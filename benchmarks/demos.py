"""Cost of demonstrations: CPU seconds each, start-up apart, with one and two workers.

    python benchmarks/demos.py [--tasks cable-line-notarget cable-ring] [--quick] [--json]

Runs the installed command `warp-deform demo` twice per row, for a few episodes and for many, and
adds up user and system time of all its processes. Steady cost is the difference of the two runs
over the difference of their episodes; start-up (interpreter, imports, loading kernels) is what the
small run has on top of that. A first run, not counted, fills the kernel cache.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

_PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_ORPHAN_PATIENCE = 30.0  # [s]


@dataclass(frozen=True)
class Run:
    """One run of the command: what its processes used, and what it reported."""

    cpu_s: float
    wall_s: float
    report: dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A task with a number of workers."""

    task: str
    workers: int
    episodes: int
    attempts: int
    mean_actions: float
    cpu_s_per_demo: float
    wall_s_per_demo: float
    startup_cpu_s: float
    startup_wall_s: float
    state_hash: str


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=["cable-line-notarget", "cable-ring"])
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--small", type=int, default=8, help="episodes of the small run")
    parser.add_argument("--big", type=int, default=72, help="episodes of the big run")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    if options.quick:
        options.tasks, options.small, options.big = options.tasks[:1], 1, 3
    if not 0 < options.small < options.big:
        parser.error(f"--small {options.small} must be positive and below --big {options.big}")
    adopt_orphans()
    rows = []
    for task in options.tasks:
        demonstrate(task, episodes=1, workers=1)
        for workers in options.workers:
            rows.append(time_task(task, workers=workers, small=options.small, big=options.big))
    if options.json:
        print(json.dumps({"cores": os.cpu_count(), "rows": [asdict(row) for row in rows]}))
    else:
        print(table(rows))


def time_task(task: str, *, workers: int, small: int, big: int) -> Row:
    """Start-up and steady cost of a task from a small and a big run on the same first seeds."""
    few = demonstrate(task, episodes=small, workers=workers)
    many = demonstrate(task, episodes=big, workers=workers)
    cpu = (many.cpu_s - few.cpu_s) / (big - small)
    wall = (many.wall_s - few.wall_s) / (big - small)
    return Row(
        task=task,
        workers=workers,
        episodes=big,
        attempts=many.report["attempts"],
        mean_actions=many.report["mean_actions"],
        cpu_s_per_demo=cpu,
        wall_s_per_demo=wall,
        startup_cpu_s=few.cpu_s - small * cpu,
        startup_wall_s=few.wall_s - small * wall,
        state_hash=many.report["state_hash"],
    )


def demonstrate(task: str, *, episodes: int, workers: int) -> Run:
    """Run the command in an empty folder and account for every process that it started."""
    with tempfile.TemporaryDirectory() as folder:
        command = [find_command(), "demo", task, "-n", str(episodes), "--workers", str(workers)]
        command += ["--out", str(Path(folder) / "demos"), "--json"]
        before, began = _children_cpu(), time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wall = time.perf_counter() - began
        reap_orphans()
        cpu = _children_cpu() - before
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        sys.exit(f"{' '.join(command)} failed with code {done.returncode}: {reason}")
    return Run(cpu, wall, json.loads(done.stdout.strip().splitlines()[-1]))


def find_command() -> str:
    """The `warp-deform` of this interpreter's environment, else the first on PATH."""
    beside = Path(sys.executable).with_name("warp-deform")
    command = str(beside) if beside.exists() else shutil.which("warp-deform")
    if command is None:
        sys.exit("the command warp-deform is not installed; run: pip install -e .")
    return command


def adopt_orphans() -> None:
    """Make processes whose parent ends before them ours, so that their CPU time is counted too."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def reap_orphans() -> None:
    """Wait for adopted processes; the workers' helpers outlive the command by a moment."""
    until = time.monotonic() + _ORPHAN_PATIENCE
    while True:
        try:
            pid, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            if time.monotonic() > until:
                sys.exit(f"a worker process still runs {_ORPHAN_PATIENCE:.0f} s after the command")
            time.sleep(0.05)


def _children_cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table, and whether the workers changed any result."""
    lines = [
        "| task | workers | episodes (attempts) | actions | CPU s per demo | wall s per demo "
        "| start-up CPU s | start-up wall s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.task} | {row.workers} | {row.episodes} ({row.attempts}) "
            f"| {row.mean_actions:.2f} | {row.cpu_s_per_demo:.4f} | {row.wall_s_per_demo:.4f} "
            f"| {row.startup_cpu_s:.2f} | {row.startup_wall_s:.2f} |"
        )
    for task in dict.fromkeys(row.task for row in rows):
        hashes = {row.state_hash for row in rows if row.task == task}
        verdict = "the same" if len(hashes) == 1 else "DIFFERENT"
        lines.append(f"\n{task}: states are {verdict} for every number of workers")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
