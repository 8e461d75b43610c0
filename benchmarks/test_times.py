"""Where the tests' time goes, file by file, and which files `make check` leaves out.

    python -m pytest -n auto --dist worksteal --junitxml=times.xml tests
    python benchmarks/test_times.py times.xml --write

The quickest files whose times sum up to the budget are checked; the others go to `tests/slow.txt`.
Seconds are those of the run, with whatever else the machine did, so the list is a rough one.
"""

from __future__ import annotations

import argparse
import collections
import xml.etree.ElementTree as ElementTree
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SLOW = ROOT / "tests" / "slow.txt"


def seconds_by_file(report: Path) -> dict[str, float]:
    """Seconds that the tests of each file took, by its path in the project."""
    total: dict[str, float] = collections.defaultdict(float)
    for case in ElementTree.parse(report).iter("testcase"):
        # "tests.project.test_house", with the class behind it where a test has one
        parts = str(case.get("classname")).split(".")
        ends = next((k for k, part in enumerate(parts) if part.startswith("test_")), None)
        if ends is None:  # a file that could not be read at all
            continue
        total["/".join(parts[: ends + 1]) + ".py"] += float(str(case.get("time")))
    return dict(total)


def slow_files(seconds: dict[str, float], budget: float) -> list[str]:
    """All but the quickest files whose times sum up to `budget` [s], by name."""
    left = budget
    slow = []
    for name, time in sorted(seconds.items(), key=lambda item: item[1]):
        left -= time
        if left < 0.0:
            slow.append(name)
    return sorted(slow)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("report", type=Path, help="what pytest wrote with --junitxml")
    parser.add_argument("--budget", type=float, default=60.0, help="of the quick half [s]")
    parser.add_argument("--write", action="store_true", help=f"write {SLOW.relative_to(ROOT)}")
    options = parser.parse_args()
    seconds = seconds_by_file(options.report)
    slow = slow_files(seconds, options.budget)
    for name, time in sorted(seconds.items(), key=lambda item: -item[1]):
        print(f"{time:8.1f} s  {'slow ' if name in slow else '     '}{name}")
    print(f"{sum(seconds.values()):8.1f} s  in {len(seconds)} files, {len(slow)} of them slow")
    if options.write:
        SLOW.write_text("".join(f"{name}\n" for name in slow))


if __name__ == "__main__":
    main()
