"""Checks in what training runs came to: settings, results, tables and curves.

    python benchmarks/learning_results.py RUNS... [--out FOLDER]

RUNS are evaluated runs, or folders that hold some. From what is written here, under OUT/runs,
`warp-deform report OUT/runs` makes the tables again.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from learning.policy.policy import AGENTS
from learning.report.read import read_runs
from learning.report.report import write_report
from learning.runs.folder import RunFolder, read_json, write_json
from learning.training.schedules import preset_schedule


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/table"))
    options = parser.parse_args()
    for note in check_in(options.runs, options.out):
        print(note)
    report = write_report([options.out / "runs"], options.out)
    print(report.text)


def check_in(paths: Sequence[Path], out: Path) -> list[str]:
    """Write what evaluated runs came to into folders under `out`/runs; returns notes on others."""
    runs, notes = read_runs(paths)
    for run in runs:
        name = f"{run.task}-{run.agent}-{run.demos}-{run.seed}"
        if run.settings["preset"] != "fast":
            name += f"-{run.settings['preset']}"
        steps = run.settings["schedule"]["steps"]
        usual = preset_schedule(
            run.settings["preset"],
            task=run.task,
            demos=run.demos,
            sees=AGENTS[run.agent].sees,
        )
        if steps != usual.steps:
            name += f"-{steps}-steps"
        if run.settings.get("goal") == "own":
            name += "-own-goals"
        if run.settings.get("given_goals"):
            name += "-given"
        by = run.settings["demonstrators"]
        if by and by != ["scripted"]:  # who else demonstrated must not replace the paper's way
            name += "-" + "-".join(each.replace(" ", "-") for each in by)
        target = RunFolder(out / "runs" / name)
        target.path.mkdir(parents=True, exist_ok=True)
        settings = {key: value for key, value in run.settings.items() if key != "data"}
        write_json(target.settings, settings)  # the path of the data is this machine's
        write_json(target.report, {k: v for k, v in run.info.items() if k != "videos"})
        write_episodes(RunFolder(run.path), run.info, target.path)
    return notes


def write_episodes(run: RunFolder, info: Mapping[str, Any], target: Path) -> None:
    """One line a test episode of the chosen snapshot, and the losses of training."""
    for path in sorted(run.evaluations.glob(f"step_{info['selected']:08d}-test-*.json")):
        record = read_json(path)
        if len(record["episodes"]) < info["test"]["n_episodes"]:
            continue  # the paper's protocol plays fewer
        label = "" if record["protocol"]["retry"] else "_no_retry"
        with (target / f"episodes{label}.csv").open("w", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            bag = any(each.get("enclosed") is not None for each in record["episodes"])
            table.writerow(["seed", "success", "score", "actions", "failure", *["enclosed"] * bag])
            for each in record["episodes"]:
                score = round(each["score"], 4)
                row = [each["seed"], int(each["success"]), score, each["actions"], each["failure"]]
                held = "" if each.get("enclosed") is None else int(each["enclosed"])
                table.writerow([*row, *[held] * bag])
    if run.log.exists():
        shutil.copyfile(run.log, target / run.log.name)


if __name__ == "__main__":
    main()
