"""What a distillation came to: a row of numbers for the documentation.

    python benchmarks/distill.py TASK --minutes M --work FOLDER [--teacher T] [--episodes N]
                                 [--seed S] [--out FILE]

Distills into FOLDER as `warp-deform distill` does, or goes on there, and adds a row to FILE unless
it holds one of the same task, teacher, budget, seed and number of test episodes. The commit is that
of the code that trained.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from learning.distillation.distill import DistillConfig, distill
from learning.runs.folder import RunFolder

RESULTS = Path("benchmarks/results/distill.jsonl")
_ASKED = ("task", "teacher", "minutes", "seed", "n_episodes")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("task")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--teacher", default="mpc")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    report = distill(
        DistillConfig(
            task=options.task,
            minutes=options.minutes,
            teacher=options.teacher,
            seed=options.seed,
            episodes=options.episodes,
            out=options.work,
        )
    )
    row = row_of(report)
    keep(row, options.out)
    print(json.dumps(row))


def row_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a report, flat; rounds stand under correction_1 and so on."""
    kept = ("task", "agent", "teacher", "seed", "minutes", "cpu_minutes", "test_cpu_minutes")
    counted = ("demos", "corrected", "labels")
    test = report["test"]
    row = {key: report[key] for key in (*kept, *counted)}
    row["steps"] = sum(each["steps"] for each in report["stages"] if "training" in each["stage"])
    for key in ("n_success", "n_episodes", "mean_score", "standard_error", "mean_actions"):
        row[key] = test[key]
    rounds = [each for each in report["stages"] if each["stage"].startswith("correction")]
    for number, each in enumerate(rounds, start=1):
        row |= {f"round_{number}_{key}": each[key] for key in ("solved", "corrected", "labels")}
    row["training_cpu_minutes"] = _minutes(report, "training")
    row["correction_cpu_minutes"] = _minutes(report, "correction")
    revisions = RunFolder(Path(report["run"])).read_settings()["revisions"]
    return {**row, "commit": revisions[-1]["commit"]}


def keep(row: Mapping[str, Any], out: Path) -> None:
    """Add a row to a file, unless it has been asked for before."""
    lines = out.read_text().splitlines() if out.exists() else []
    asked = [row[key] for key in _ASKED]
    if any([json.loads(line)[key] for key in _ASKED] == asked for line in lines):
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("\n".join([*lines, json.dumps(row)]) + "\n")


def _minutes(report: Mapping[str, Any], kind: str) -> float:
    seconds = [each["cpu_seconds"] for each in report["stages"] if kind in each["stage"]]
    return sum(seconds) / 60


if __name__ == "__main__":
    main()
