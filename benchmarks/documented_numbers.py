"""Measured numbers in the README and in docs, and the command or file that each comes from.

    python benchmarks/documented_numbers.py            what has no source, page by page
    python benchmarks/documented_numbers.py --write    take that as the list of what is allowed to

A measurement is a number with a unit of time, a percentage, a ratio ("3 times") or a count ("7 of
20"). Its source is named in its section (between two headings): a file of this repository, which
has to be there, or a command `warp-deform bench` or `gradcheck`. A file of results may be named for
one paragraph, in a comment that no reader sees, and then has to hold all its measurements:

    <!-- from: benchmarks/results/learning/report.csv -->

`documented_numbers.txt` beside this file lists what has no source yet. It may only shrink.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = Path(__file__).with_suffix(".txt")

_NUMBER = r"(?<![\w.,/`-])\d[\d,]*(?:\.\d+)?"
_UNIT = (
    r"CPU s\b|CPU seconds|CPU minutes|CPU hours|CPU-hours|ms\b|us\b|minutes\b|hours\b|%|times\b"
    r"|of \d[\d,]*\b"
)
_CLAIM = re.compile(rf"({_NUMBER})(?: (?:to|and|or) ({_NUMBER}))? ?({_UNIT})")
_FILE = re.compile(r"(?:benchmarks|tests|examples|learning|hardware|warp_deform)/[\w/.-]*\w")
_PLACEHOLDER = re.compile(r"\b[A-Z]{2,}\b")
_COMMAND = re.compile(r"warp-deform (?:bench|gradcheck)\b|make (?:demo|test|bench)\b")
_FROM = re.compile(r"<!-- from: (\S+) -->")
_CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_CONFIDENCE = re.compile(r"95 % (?:Wilson|interval|confidence)|95 %\s*\|")
_VALUE = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_SCALES = (1.0, 100.0, 1000.0, 1 / 60, 1 / 3600)
"""Shares as percent, seconds as milliseconds, minutes or hours."""


@dataclass(frozen=True)
class Claim:
    """A measurement: the page, the numbers as they are printed, the unit, and the paragraph."""

    page: str
    numbers: tuple[str, ...]
    unit: str
    paragraph: str

    def __str__(self) -> str:
        return f"{self.page}: {' to '.join(self.numbers)} {self.unit}"


def pages() -> list[Path]:
    """README and the pages of docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def sections(text: str) -> list[str]:
    """The text between two headings, without programs."""
    return re.split(r"^#+ .*$", _CODE.sub("", text), flags=re.MULTILINE)


def claims(page: str, section: str) -> list[Claim]:
    """Measurements of a section."""
    found = []
    for paragraph in re.split(r"\n\s*\n", section):
        text = _CONFIDENCE.sub("", " ".join(paragraph.split()))
        for match in _CLAIM.finditer(_FROM.sub("", text)):
            numbers = tuple(each for each in match.groups()[:2] if each)
            found.append(Claim(page, numbers, match[3], text))
    return found


def holds(file: Path, number: str) -> bool:
    """Whether a file of results holds a number, rounded as it is printed."""
    digits, wanted = len(number.partition(".")[2]), float(number.replace(",", ""))
    values = {float(value) for value in _VALUE.findall(file.read_text())}
    return any(round(value * scale, digits) == wanted for value in values for scale in _SCALES)


def examine(page: str, text: str) -> tuple[list[Claim], list[str]]:
    """Measurements of a page without a source; and what is wrong with the sources it names."""
    bare, wrong = [], []
    for section in sections(text):
        named = [name for name in _FILE.findall(section) if not _PLACEHOLDER.search(name)]
        found = claims(page, section)
        if found and not named and not _COMMAND.search(section):
            bare += [claim for claim in found if not _FROM.search(claim.paragraph)]
        wrong += [
            f"{page} names {name}, which is not there"
            for name in dict.fromkeys(named)
            if not (ROOT / name).exists()
        ]
        for claim in found:
            for source in _FROM.findall(claim.paragraph):
                if not (ROOT / source).is_file():
                    wrong.append(f"{page} names {source}, which is not there")
                elif missing := [n for n in claim.numbers if not holds(ROOT / source, n)]:
                    wrong.append(f"{claim}: {source} does not hold {', '.join(missing)}")
    return bare, wrong


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
