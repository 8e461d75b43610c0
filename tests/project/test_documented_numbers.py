"""Every measurement that README and docs print is compared with a file, or says why it is not."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import documented_numbers as numbers
import documented_values as values

from learning.evaluation.clustered import clustered_mean, clustered_rate

REPORT = "benchmarks/results/table/report.csv"
CELL = f"{REPORT}[task=cable-shape,agent=transporter,demos=100,variant~patience]"
PERCENT = "table_percent 1.96*table_percent_standard_error"


def examined() -> dict[Path, tuple[str, list[numbers.Figure]]]:
    """The text and the figures of every page."""
    texts = {path: path.read_text() for path in numbers.pages()}
    return {path: (text, numbers.examine(path.name, text)[0]) for path, text in texts.items()}


@pytest.mark.parametrize("path", numbers.pages(), ids=lambda path: path.name)
def test_measurements_are_those_of_their_sources(path: Path) -> None:
    figures, wrong = numbers.examine(str(path.relative_to(ROOT)), path.read_text())
    assert wrong == []
    allowed = set(numbers.ALLOWED.read_text().splitlines())
    assert {str(figure) for figure in figures if figure.kind == "bare"} <= allowed, (
        "name the command or file of these numbers in their section, or see "
        "benchmarks/documented_numbers.py"
    )


def test_most_measurements_are_compared_with_a_file() -> None:
    measured = [each for _, figures in examined().values() for each in figures if each.unit]
    compared = [each for each in measured if each.kind == "compared"]
    assert len(compared) >= 350 and len(compared) >= 0.85 * len(measured)
    assert all(len(each.values) == len(each.numbers) for each in compared)


def test_a_changed_digit_is_found() -> None:
    """Of thirty compared numbers, drawn from all, in one digit each; a page is read for each."""
    rng = random.Random(0)
    pages = examined()
    held = [
        (path, at, number)
        for path, (_, figures) in pages.items()
        for figure in figures
        if figure.kind == "compared"
        for at, number in figure.numbers
    ]
    noticed = 0
    for path, at, number in rng.sample(held, 30):
        text = pages[path][0]
        mantissa = number.partition("e")[0]
        digit = at + rng.choice([i for i, each in enumerate(mantissa) if each.isdigit()])
        other = rng.choice([each for each in "0123456789" if each != text[digit]])
        noticed += bool(numbers.examine(path.name, text[:digit] + other + text[digit + 1 :])[1])
    assert noticed >= 28


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("It is 3.5 times as fast.", ["3.5 times"]),
        ("Takes 14 to 22 CPU minutes.", ["14 to 22 CPU minutes"]),
        ("Costs 10, 116 and\n328 CPU seconds.", ["10, 116 and\n328 CPU seconds"]),
        ("Lies 20 and 35 % off.", ["20 and 35 %"]),
        ("Solves 7 of 20, 35 %.", ["7 of 20", "35 %"]),
        ("Solves 0, 2 and 1 of 10.", ["0, 2 and 1 of 10"]),
        ("6 of 261 edges in 8 of 25 x 25, 9 ms for 10 x 10, 87 ms", ["6 of 261", "9 ms", "87 ms"]),
        ("Errors of -0.6 % and 0.45-0.52 m.", ["-0.6 %"]),
        ("From 5.08 -> 3.30.", ["5.08 -> 3.30"]),
        ("59.8 ± 5.3 (61 / 200)", ["59.8 ± 5.3", "61 / 200"]),
        ("| a | 12 ms |", ["12 ms"]),
        ("| a | in 12 ms | 95 % |\n|---|---|---|\n| 3 % | b | 4 |\n", ["12 ms", "3 %"]),
        ("The 95 % Wilson interval of 0.5 m, seeds 0 to 10, `--lr 3 %`.", []),
        ("```\nin 3 ms\n```", []),
    ],
)
def test_what_counts_as_a_measurement(text: str, expected: list[str]) -> None:
    figures, wrong = numbers.examine("page", text)
    assert [each.text for each in figures] == expected and wrong == []
    assert {each.kind for each in figures} <= {"bare"}
    for figure in figures:
        assert all(text[at:].startswith(number) for at, number in figure.numbers)


def kinds(text: str) -> list[str]:
    figures, wrong = numbers.examine("page", text)
    assert wrong == []
    return [each.kind for each in figures]


def test_a_command_speaks_for_its_section_and_a_comment_for_its_paragraph() -> None:
    assert kinds("3 ms, see `benchmarks/physics.py`.") == ["command"]
    assert kinds("3 ms, see `warp-deform bench`.") == ["command"]
    assert kinds("3 ms, `benchmarks/physics.py`.\n\n## Next\n\n4 ms") == ["command", "bare"]
    source = f"<!-- from: {CELL} n_success n_episodes -->"
    assert kinds(f"122 / 200\n{source}") == ["compared"]
    assert kinds(f"122 / 200\n{source}\n\n122 / 200") == ["compared", "bare"]
    assert kinds(f"Of 20 %, 122 of 200\n<!-- from: -setting {CELL} n_success n_episodes -->") == [
        "setting",
        "compared",
    ]


@pytest.mark.parametrize(
    ("text", "expressions"),
    [
        ("122 / 201", "n_success n_episodes"),
        ("121 / 200", "n_success n_episodes"),
        ("200 of 122", "n_success n_episodes"),
        ("87.5 ± 2.8", PERCENT),
        ("87.6 ± 2.7", PERCENT),
        ("87.5 ± 2.7", f"{PERCENT}+0.1"),
        ("87.5 ± 2.7", "table_percent"),
        ("87.5 ± 2.7", f"{PERCENT} n_success"),
        ("87.5 ± 2.7", "table_percent nothing"),
        ("87.5 ± 2.7", "table_percent failures_physics/failures_physics"),
        ("87.5 ± 2.7", "table_percent __import__('os')"),
    ],
)
def test_what_a_file_does_not_say_is_found(text: str, expressions: str) -> None:
    assert numbers.examine("page", f"{text}\n<!-- from: {CELL} {expressions} -->")[1]


def test_sources_have_to_be_there_and_to_choose_rows_that_agree() -> None:
    for gone in ("benchmarks/gone.py", "benchmarks/results/gone.json"):
        assert numbers.examine("page", f"3 ms, `{gone}`")[1] == [
            f"page names {gone}, which is not there"
        ]
    for source, why in (
        ("tests/gone.json", "which is not there"),
        (f"{REPORT}[task=none]", "no such rows"),
        (f"{REPORT}[task=cable-shape]", "different numbers"),
        (f"{REPORT}[nothing=1]", "no such rows"),
        ("", "of no file"),
        ("-test", "1 numbers: 3"),
    ):
        (wrong,) = numbers.examine("page", f"3 %\n<!-- from: {source} table_percent -->")[1]
        assert why in wrong
    assert "of another kind" in numbers.examine("page", "3 ms\n<!-- form: a.csv x -->")[1][0]
    assert "belong to no paragraph" in numbers.examine("page", "<!-- from: a.csv x -->")[1][0]


def test_a_reason_has_to_be_true_of_its_section() -> None:
    cases = {"test": "tests/warp_deform/tasks/test_suite.py", "command": "benchmarks/physics.py"}
    for reason, named in cases.items():
        text = f"3 ms\n<!-- from: -{reason} -->\n\n"
        assert kinds(f"{text}See `{named}`.") == [reason]
        for other in ("", "See `learning/__init__.py`.") if reason == "test" else ("",):
            assert f"no {reason} is named" in numbers.examine("page", text + other)[1][0]
    table = "<!-- table: 2: -setting* -->\n\n| a | b |\n|---|---|\n| c | 3 %, 4 m, 5 |\n"
    assert kinds(table) == ["setting"]
    assert kinds("| a | 3 %, `tests/warp_deform/tasks/test_suite.py` |") == ["test"]


def test_tables_are_compared_row_by_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rows.csv").write_text("task,part,share\nwhole,0,0.5\nwhole,1,0.25\nhalf,0,0.1\n")
    (tmp_path / "paper.jsonl").write_text('{"task": "whole", "paper": 40.0}\n')
    for module in (numbers, values):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    head = "| of | share | both |\n|---|---|---|\n"
    comment = "<!-- table: rows.csv[task=$1.1,part=$1.2] 2: 100*share 3: 100*share 7 | 7 -->\n\n"
    good = "| `whole`, 1 | 25 % | 25.0, 7 |\n| Half, 0 | 10.0 % | 7 |\n| whole, 0 | - | |\n"
    assert numbers.examine("page", comment + head + good)[1] == []
    for bad in ("| whole, 1 | 50 % | |", "| none, 0 | 5 % | |", "| whole, 0 | 50 % | 50, 7, 1 |"):
        assert numbers.examine("page", comment + head + bad)[1], bad
    joined = "{} times\n<!--from: rows.csv+paper.jsonl[part=0]\n100*share-paper\n-->"
    assert numbers.examine("page", joined.format(10))[1] == []
    assert numbers.examine("page", joined.format(80))[1]
    (tmp_path / "by.jsonl").write_text(
        '{"task": "whole", "by": "a", "share": 2}\n{"task": "whole", "by": "b", "share": 4}\n'
    )
    ratio = "{} %\n<!--from: rows.csv+by.jsonl[part=0,by=b]\n100*share/other_share\n-->"
    assert numbers.examine("page", ratio.format(12.5))[1] == []
    of_first = ratio.replace("by=b", "by=b,share=0.5").format(12.5)
    assert numbers.examine("page", of_first)[1] == []
    both = ratio.replace(",by=b", ",task=whole").format(12.5)
    assert "2 different numbers" in numbers.examine("page", both)[1][0]
    nowhere = comment.replace("2: ", "")
    assert "without a column" in numbers.examine("page", nowhere + head + good)[1][0]
    twice = comment + comment + head + good
    assert "2 comments are for the row" in numbers.examine("page", twice)[1][0]


def test_expressions_say_counts_means_and_intervals() -> None:
    rows = [
        {"kind": kind, "solved": solved, "score": score, "pair": [score, {"deep": 2}]}
        for kind, solved, score in (("a", 1, 0.9), ("a", 0, 0.5), ("b", 1, 0.8), ("b", 1, 0.2))
    ]
    rates = clustered_rate([1, 0, 1, 1], ["a", "a", "b", "b"])
    half = clustered_mean([0.9, 0.5, 0.8, 0.2], ["a", "a", "b", "b"])[1]
    for expression, value in (
        ("count(solved)", 3), ("rows()", 4), ("mean(score)", 0.6), ("median(score)", 0.65),
        ("least(score)", 0.2), ("most(score[score<0.85])", 0.8), ("count(score>0.5)", 2),
        ("sum(pair[0])/rows()", 0.6), ("sum(pair[1].deep)", 8), ("-1+2*3", 5),
        ("low(3,4)", 30.06), ("high(3,4)", 95.44), ("rate_low(solved,kind)", rates[0]),
        ("rate_high(solved,kind)", rates[1]), ("group_error(score,kind)", half),
    ):  # fmt: skip
        assert values.evaluate(expression, rows) == pytest.approx(value, abs=0.01), expression
    assert values.evaluate("error(score)", rows) == pytest.approx(1.96 * 0.3162 / 2, abs=1e-3)
    for bad in ("score", "kind", "open('x')", "score.real", "[1]", "solved and score", "1+", "x"):
        with pytest.raises(ValueError, match=r"."):
            values.evaluate(bad, rows)


@pytest.mark.parametrize(
    ("value", "number", "same"),
    [(83.75, "83.8", True), (83.75, "83.7", True), (83.76, "83.7", False), (4096.0, "4,096", True),
     (7.62e-7, "7.6e-7", True), (7.62e-7, "7.7e-7", False), (0.5, "1", True), (0.49, "1", False),
     (-0.04, "-0.0", True), (-0.6, "+0.6", False), (520.0, "5.2e+02", True)],
)  # fmt: skip
def test_a_number_is_rounded_as_it_is_printed(value: float, number: str, same: bool) -> None:
    assert numbers.prints(value, number) is same


def test_the_list_of_what_has_no_source_is_empty() -> None:
    """It held what stood in the pages when they were first examined; nothing is added."""
    assert numbers.ALLOWED.read_text() == ""
