"""Every measurement that README and docs print names the command or the file that it comes from."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
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
        ("Solves 7 of 20, 35 %.", ["page: 35 %", "page: 7 of 20"]),
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
    for text in ("90.3 ± 2.6", "142 / 200", "58 of the 200", "63.0 (53.2 to 71.8)"):
        assert numbers.examine("page", f"{text}\n<!-- from: {source} -->") == ([], [])
    bare, wrong = numbers.examine("page", f"Solved: 31.41592 %.\n<!-- from: {source} -->")
    assert bare == [] and wrong == [f"page: 31.41592 %: {source} does not hold 31.41592"]
    # Each number is there, but not in one row.
    for text in ("90.3 ± 0.7", "142 / 300", "63.0 (98.1 to 100.0)"):
        assert numbers.examine("page", f"{text}\n<!-- from: {source} -->")[1], text
    for gone in ("benchmarks/gone.py", "benchmarks/results/gone.json"):
        assert numbers.examine("page", f"3 ms, `{gone}`")[1] == [
            f"page names {gone}, which is not there"
        ]
    assert numbers.examine("page", "3 ms\n<!-- from: tests/gone.json -->")[1][-1].endswith(
        "tests/gone.json, which is not there"
    )
    assert numbers.examine("page", f"3 %\n<!-- from: {source}[task=none] -->")[1] == [
        f"page: {source}[task=none] chooses no rows"
    ]


def test_a_source_speaks_for_its_paragraph_or_by_itself_for_its_section() -> None:
    source = "<!-- from: benchmarks/results/learning/report.csv -->"
    one, two = "142 / 200", "143 / 200"
    assert claims(f"{one}\n{source}\n\n{two}") == [f"page: {two}"]
    assert numbers.examine("page", f"{source}\n\n{one}\n\n{two}")[1] == [
        f"page: {two}: benchmarks/results/learning/report.csv does not hold 143 with 200"
    ]
    assert claims(f"{source}\n\n{one}\n\n## Next\n\n{one}") == [f"page: {one}"]


def test_units_say_how_a_value_may_be_written(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text('{"share": 0.8375, "seconds": 0.0123, "cpu": 90.0, "flag": true}')
    for text in ("83.8 %", "12.3 ms", "12 ms", "1.5 CPU minutes", "90 CPU s"):
        (claim,) = numbers.claims("page", text)
        assert numbers.holds(str(file), claim) == [], text
    for text in ("83.6 %", "13 ms", "12 %", "83.8 ms", "1.5 CPU s", "2 ms"):
        (claim,) = numbers.claims("page", text)
        assert numbers.holds(str(file), claim) != [], text


def test_rows_together_say_counts_means_and_extremes(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    file.write_text("kind,success,score\na,1,0.9\na,0,0.5\nb,1,0.8\nb,1,0.2\n")
    for text in ("3 of 4", "60 %", "65 %", "60.0 ± 31.0"):
        (claim,) = numbers.claims("page", text)
        assert numbers.holds(str(file), claim) == [], text
    (claim,) = numbers.claims("page", "2 of 2")
    assert numbers.holds(f"{file}[kind=b]", claim) == []
    assert numbers.holds(f"{file}[kind=a,score=0.5|0.9]", claim) == []
    (claim,) = numbers.claims("page", "3 of 5")
    assert numbers.holds(str(file), claim) == ["3 with 5"]


def held_by_files(path: Path) -> list[object]:
    found = [c for s in numbers.sections(path.read_text()) for c in numbers.claims("page", s)]
    return [c for c in found if "<!-- from:" in c.paragraph]


@pytest.mark.parametrize(
    "path", [each for each in numbers.pages() if held_by_files(each)], ids=lambda path: path.name
)
def test_a_changed_digit_is_found(path: Path) -> None:
    """Where a file has many rows another number may be there by chance, so one is enough."""
    held = [(c, n) for c in held_by_files(path) for n in c.numbers]
    found = 0
    for claim, number in held:
        last = int(number[-1])
        changed = number[:-1] + str((last + 3) % 10)
        found += bool(list(numbers._wrong(replace(claim, numbers=(changed,)))))
    assert found


def test_the_list_of_what_has_no_source_is_short() -> None:
    """It holds what stood in the pages when they were first examined; nothing is added."""
    assert len(numbers.ALLOWED.read_text().splitlines()) <= 4
