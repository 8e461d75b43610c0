"""Every measurement that README and docs print names the command or the file that it comes from."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
_SPEC = importlib.util.spec_from_file_location(
    "documented_numbers", ROOT / "benchmarks" / "documented_numbers.py"
)
assert _SPEC is not None and _SPEC.loader is not None
numbers = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = numbers
_SPEC.loader.exec_module(numbers)


@pytest.mark.parametrize("path", numbers.pages(), ids=lambda path: path.name)
def test_measurements_name_a_source_that_is_there(path: Path) -> None:
    bare, wrong = numbers.examine(str(path.relative_to(ROOT)), path.read_text())
    assert wrong == []
    allowed = set(numbers.ALLOWED.read_text().splitlines())
    assert {str(claim) for claim in bare} <= allowed, (
        "name the command or file of these numbers in their section, or see "
        "benchmarks/documented_numbers.py"
    )


def claims(text: str) -> list[str]:
    return [str(claim) for claim in numbers.examine("page", text)[0]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("It is 3.5 times as fast.", ["page: 3.5 times"]),
        ("Takes 14 to 22 CPU minutes.", ["page: 14 to 22 CPU minutes"]),
        ("Solves 7 of 20 and 35 %.", ["page: 7 of 20", "page: 35 %"]),
        ("| a | 12 ms |", ["page: 12 ms"]),
        ("The 95 % Wilson interval of 0.5 m, seeds 0 to 10.", []),
        ("```\nin 3 ms\n```", []),
        ("3 ms, see `benchmarks/physics.py`.", []),
        ("3 ms, see `warp-deform bench`.", []),
        ("3 ms, see `benchmarks/physics.py`.\n\n## Next\n\n4 ms", ["page: 4 ms"]),
    ],
)
def test_what_counts_as_a_measurement(text: str, expected: list[str]) -> None:
    assert claims(text) == expected


def test_a_source_has_to_be_there_and_a_file_of_results_to_hold_the_number() -> None:
    source = "benchmarks/results/learning/report.csv"
    row = (ROOT / source).read_text().splitlines()[1].split(",")
    held = next(cell for cell in row if cell.replace(".", "").isdigit() and "." in cell)
    percent = f"{float(held):.1f} %"
    assert numbers.examine("page", f"Solved: {percent}.\n<!-- from: {source} -->") == ([], [])
    bare, wrong = numbers.examine("page", f"Solved: 31.41592 %.\n<!-- from: {source} -->")
    assert bare == [] and wrong == [f"page: 31.41592 %: {source} does not hold 31.41592"]
    for gone in ("benchmarks/gone.py", "benchmarks/results/gone.json"):
        assert numbers.examine("page", f"3 ms, `{gone}`")[1] == [
            f"page names {gone}, which is not there"
        ]
    assert numbers.examine("page", "3 ms\n<!-- from: tests/gone.json -->")[1][-1].endswith(
        "tests/gone.json, which is not there"
    )


def test_shares_are_held_as_percent_and_seconds_as_milliseconds(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text('{"share": 0.8375, "seconds": 0.0123, "n": 1200, "cpu": 90.0}')
    for number in ("83.8", "0.84", "12.3", "12", "1,200", "1.5"):
        assert numbers.holds(file, number), number
    for number in ("83.7", "0.83", "13", "1,201"):
        assert not numbers.holds(file, number), number


def test_the_list_of_what_has_no_source_is_short() -> None:
    """It holds what stood in the pages when they were first examined; nothing is added."""
    assert len(numbers.ALLOWED.read_text().splitlines()) <= 30
