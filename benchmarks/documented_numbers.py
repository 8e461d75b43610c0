"""Measured numbers in the README and in docs, and the command or file that each comes from.

    python benchmarks/documented_numbers.py            what has no source, page by page
    python benchmarks/documented_numbers.py --write    take that as the list of what is allowed to

A measurement is a number with a unit of time, a percentage, a ratio ("3 times"), a count ("7 of
20", "7 / 20"), or a value with what it is uncertain by ("90.3 ± 2.6", "63.0 (53.2 to 71.8)"). Its
source is named in its section (between two headings): a file of this repository, which has to be
there, or a command `warp-deform bench` or `gradcheck`. Files of results are named in a comment
that no reader sees, which speaks for its paragraph, or, standing by itself, for those paragraphs
of its section that have none of their own. One of its files has to hold each measurement:

    <!-- from: benchmarks/results/learning/report.csv[task=cable-shape] FILE -->

Brackets choose rows (`task=a|b,demos=100`); objects in a JSON file count as rows too. The parts
of a count, or of a value and its uncertainty, have to stand in one row, or come from the chosen
rows together: their number, how many have a value in common, and the mean (± 1.96 standard
errors), median, least and greatest of a column. A Python file is a command: it has to be there.

`documented_numbers.txt` beside this file lists what has no source yet. It may only shrink.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = Path(__file__).with_suffix(".txt")

_NUMBER = r"(?<![\w.,/`-])\d[\d,]*(?:\.\d+)?"
_UNIT = r"CPU s\b|CPU seconds|CPU minutes|CPU hours|CPU-hours|ms\b|us\b|minutes\b|hours\b|%|times\b"
_TOTAL = r"\d+(?:,\d{3})*\b(?![.]\d)"
_PLAIN = r"\d+(?:\.\d+)?"
_CLAIMS = (
    re.compile(rf"({_NUMBER})(?: (?:to|and|or) ({_NUMBER}))? ?({_UNIT})"),
    re.compile(rf"({_NUMBER})(?: (?:to|and|or) ({_NUMBER}))? (of (?:the )?{_TOTAL})"),
    re.compile(rf"({_NUMBER})() (/ \d{{2,}}\b)"),
    re.compile(rf"({_NUMBER})() (± {_PLAIN})"),
    re.compile(rf"({_NUMBER})() (\({_PLAIN} to {_PLAIN}\))"),
)
_FILE = re.compile(r"(?:benchmarks|tests|examples|learning|hardware|warp_deform)/[\w/.-]*\w")
_PLACEHOLDER = re.compile(r"\b[A-Z]{2,}\b")
_COMMAND = re.compile(r"warp-deform (?:bench|gradcheck)\b|make (?:demo|test|bench)\b")
_FROM = re.compile(r"<!-- from: (.+?) -->")
_SOURCE = re.compile(r"(?P<file>[^\[\]]+)(?:\[(?P<chosen>[^\]]+)\])?")
_CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_CONFIDENCE = re.compile(r"95 % (?:Wilson|interval|confidence)|95 %\s*\|")
_NORMAL = 1.96
"""Standard errors of an interval of 95 %."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Claim:
    """A measurement: the page, the numbers as they are printed, the unit, and the paragraph."""

    page: str
    numbers: tuple[str, ...]
    unit: str
    paragraph: str

    def __str__(self) -> str:
        return f"{self.page}: {' to '.join(self.numbers)} {self.unit}"

    @property
    def scales(self) -> tuple[float, ...]:
        """What values in files are multiplied by: shares, and seconds, may stand for the unit."""
        if self.unit.startswith(("%", "±", "(")):
            return (1.0, 100.0)
        if self.unit == "ms":
            return (1.0, 1e3)
        if self.unit == "us":
            return (1.0, 1e6)
        if "minutes" in self.unit:
            return (1.0, 1 / 60)
        return (1.0, 1 / 3600) if "hours" in self.unit else (1.0,)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Numbers that have to stand in one row together."""
        rest = tuple(re.findall(_TOTAL if self.unit[0] in "o/" else _PLAIN, self.unit))
        return [(number, *rest) for number in self.numbers]


def pages() -> list[Path]:
    """README and the pages of docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def sections(text: str) -> list[str]:
    """The text between two headings, without programs."""
    return re.split(r"^#+ .*$", _CODE.sub("", text), flags=re.MULTILINE)


def paragraphs(section: str) -> list[str]:
    """Paragraphs, each on one line; what names the section's sources is added to those without."""
    every = [" ".join(each.split()) for each in re.split(r"\n\s*\n", section)]
    whole = [each for each in every if _FROM.search(each) and not _FROM.sub("", each).strip()]
    return [
        each if _FROM.search(each) else " ".join([each, *whole])
        for each in every
        if each not in whole
    ]


def claims(page: str, section: str) -> list[Claim]:
    """Measurements of a section."""
    found = []
    for paragraph in paragraphs(section):
        text = _CONFIDENCE.sub("", paragraph)
        bare = _FROM.sub("", text)
        for form in _CLAIMS:
            for match in form.finditer(bare):
                numbers = tuple(each for each in match.groups()[:2] if each)
                found.append(Claim(page, numbers, match[3], text))
    return found


def _objects(value: Any) -> Iterator[Row]:
    if isinstance(value, dict):
        yield value
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from _objects(each)


def _cell(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


@cache
def rows(file: Path) -> list[Row]:
    """The rows of CSV or JSON lines, or all objects of a JSON file."""
    if file.suffix == ".csv":
        with file.open(newline="") as lines:
            return [{k: _cell(v) for k, v in row.items()} for row in csv.DictReader(lines)]
    if file.suffix == ".jsonl":
        return [json.loads(line) for line in file.read_text().splitlines() if line]
    return list(_objects(json.loads(file.read_text())))


def _numbers(row: Row) -> set[float]:
    """Numbers of a row and of its lists; half of an interval, and the failed episodes."""
    held = set()
    for name, value in row.items():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, (int, float)) and not isinstance(each, bool):
                held.add(float(each))
                if name.endswith("error"):
                    held.add(_NORMAL * each)
    if "n_episodes" in row and "n_success" in row:
        held.add(float(row["n_episodes"] - row["n_success"]))
    return held


def _together(chosen: list[Row]) -> Iterator[set[float]]:
    """What rows say together: columns' means, medians, extremes; how many share a value."""
    for name in sorted({name for row in chosen for name in row}):
        values = [row.get(name) for row in chosen]
        flags = [each for each in values if isinstance(each, (str, bool)) or each in (0, 1)]
        for count in Counter(map(str, flags)).values():
            yield {float(count), float(len(chosen))}
        column = [each for each in values if isinstance(each, (int, float))]
        if column:
            error = stdev(column) / len(column) ** 0.5 if len(column) > 1 else 0.0
            yield {float(f(column)) for f in (mean, median, min, max)} | {_NORMAL * error}


def holds(source: str, claim: Claim) -> list[str]:
    """The claim's numbers that a source (a file, perhaps with rows chosen) does not hold.

    Raises:
        ValueError: The source chooses rows that are not there.
    """
    match = _SOURCE.fullmatch(source)
    assert match is not None
    chosen = rows(ROOT / match["file"])
    for condition in (match["chosen"] or "").split(",") if match["chosen"] else []:
        name, _, wanted = condition.partition("=")
        values = [_cell(each) for each in wanted.split("|")]
        chosen = [row for row in chosen if name in row and row[name] in values]
    if not chosen:
        raise ValueError(f"{source} chooses no rows")
    sets = [_numbers(row) for row in chosen] + list(_together(chosen))
    return [
        " with ".join(group)
        for group in claim.groups
        if not any(
            all(
                any(_prints(value * scale, number) for value in values for scale in claim.scales)
                for number in group
            )
            for values in sets
        )
    ]


def _prints(value: float, number: str) -> bool:
    """Whether a value is printed as this number; half a last digit may go either way."""
    digits, wanted = len(number.partition(".")[2]), float(number.replace(",", ""))
    return abs(value - wanted) <= 0.5 * 10.0**-digits * (1 + 1e-6)


def _wrong(claim: Claim) -> Iterator[str]:
    """What is wrong with the sources that the claim's paragraph names in comments."""
    missing: list[list[str]] = []
    sources = [each for names in _FROM.findall(claim.paragraph) for each in names.split()]
    for source in sources:
        file = source.partition("[")[0]
        if not (ROOT / file).is_file():
            yield f"{claim.page} names {file}, which is not there"
        elif file.endswith(".py"):
            missing.append([])
        else:
            try:
                missing.append(holds(source, claim))
            except ValueError as error:
                yield f"{claim.page}: {error}"
    if missing and (nowhere := set.intersection(*map(set, missing))):
        yield f"{claim}: {' '.join(sources)} does not hold {', '.join(sorted(nowhere))}"


def examine(page: str, text: str) -> tuple[list[Claim], list[str]]:
    """Measurements of a page without a source; and what is wrong with the sources it names."""
    bare, wrong = [], []
    for section in sections(text):
        seen = _FROM.sub("", section)
        named = [name for name in _FILE.findall(seen) if not _PLACEHOLDER.search(name)]
        found = claims(page, section)
        if found and not named and not _COMMAND.search(section):
            bare += [claim for claim in found if not _FROM.search(claim.paragraph)]
        wrong += [
            f"{page} names {name}, which is not there"
            for name in dict.fromkeys(named)
            if not (ROOT / name).exists()
        ]
        for claim in found:
            wrong += _wrong(claim)
    return bare, list(dict.fromkeys(wrong))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write the list of what has no source")
    options = parser.parse_args()
    lines = []
    for path in pages():
        bare, wrong = examine(str(path.relative_to(ROOT)), path.read_text())
        lines += [str(claim) for claim in bare]
        for line in wrong:
            print("wrong:", line)
    lines = sorted(set(lines))
    print("\n".join(lines))
    if options.write:
        ALLOWED.write_text("".join(f"{line}\n" for line in lines))


if __name__ == "__main__":
    main()
