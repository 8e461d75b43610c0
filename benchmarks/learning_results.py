"""Checks in what training runs came to: settings, results, tables and curves; of some the policy.

    python benchmarks/learning_results.py RUNS... [--share RUN...] [--out FOLDER]

RUNS are evaluated runs, or folders that hold some. `warp-deform report benchmarks/results/learning`
makes the tables again from what is written here. Policies of --share are written as by
`warp-deform eval RUN --share`, under policies/.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.report import read_runs, write_report
from learning.share import share_run
from learning.snapshots import RunFolder, write_json


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--share", nargs="+", type=Path, default=[], help="runs to hand on")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/learning"))
    options = parser.parse_args()
    found, notes = read_runs(options.runs)
    for note in notes:
        print(note)
    for run in found:
        name = f"{run.task}-{run.agent}-{run.demos}-{run.seed}"
        target = RunFolder(options.out / "runs" / name)
        target.path.mkdir(parents=True, exist_ok=True)
        settings = {key: value for key, value in run.settings.items() if key != "data"}
        write_json(target.settings, settings)  # the path of the data is this machine's
        write_json(target.report, {k: v for k, v in run.info.items() if k != "videos"})
    for path in options.share:
        share_run(path, options.out / "policies" / path.name)
    report = write_report([options.out / "runs"], options.out)
    print(report.text)


if __name__ == "__main__":
    main()
