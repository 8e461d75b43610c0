"""Measured numbers in the README and in docs, and the file or command that each comes from.

    python benchmarks/documented_numbers.py            how many are compared, why others are not
    python benchmarks/documented_numbers.py --values   the same, and what each is compared with
    python benchmarks/documented_numbers.py --write    list what has no source as allowed

A measurement is a number, or several, with a unit of time, a percentage, a ratio ("3 times"), a
count ("7 of 20", "7 / 20"), or a value with what it is uncertain by ("90.3 ± 2.6", "63.0 (53.2 to
71.8)"). Comments that no reader sees say what its numbers are compared with, one expression a
number, in the order in which they are printed (`documented_values.py` says what may stand there):

    <!-- from: FILE[ROWS] EXPRESSION EXPRESSION FILE[ROWS] EXPRESSION -setting -->

behind a paragraph or list, and before a table, by column, for each of its rows:

    <!-- table: FILE[task=$1] 2: successes attempts 4: 100*share | 100*share 100*error -->

Behind a bar stands what a cell with another number of numbers is compared with. Of a mapped column
every number is compared, measurement or not, and cells without one are passed over. A number is as
the file has it if rounding to the printed digits gives it. In place of an expression, a word says
why there is none: `-setting` (chosen, not measured), `-published` (by others), `-test` (held by a
test that the section names), `-command` (the command that the section names prints it, and no file
keeps it); `-setting*` is for all numbers of a column. Without a comment a paragraph or a row that
names a test is held by it, and by a command that its section names; `documented_numbers.txt` beside
this file lists what has none of these. Numbers in other columns of tables are counted, by page.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

from documented_values import ROOT, chosen, evaluate, files_of, is_source

ALLOWED = Path(__file__).with_suffix(".txt")
WHY = {
    "setting": "chosen, not measured",
    "published": "published by others",
    "test": "held by a test that its section names",
    "command": "printed by a command that its section names, and kept in no file",
    "bare": "no source",
}

_NUMBER = r"(?<![\w.,/^-])(?<!\bx\s)[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?"
_LIST = rf"{_NUMBER}(?:(?:, | to | and | or ){_NUMBER})*"
_UNIT = r"CPU s\b|CPU seconds|CPU minutes|CPU hours|CPU-hours|ms\b|us\b|minutes\b|hours\b|%|times\b"
_TOTAL = r"\d+(?:,\d{3})*\b(?!\.\d| ?%| x )"
_MEASUREMENT = re.compile(
    rf"{_NUMBER} ± [\d.]+|{_NUMBER} \([\d.]+ to [\d.]+\)|{_NUMBER} -> {_NUMBER}"
    rf"|{_NUMBER} / \d{{2,}}\b|{_LIST} of (?:the )?{_TOTAL}|{_LIST} ?(?:{_UNIT})".replace(
        " ", r"\s+"
    ).replace(r"\s+?", r"\s?")
)
_PRINTED = re.compile(r"(?<![\w.])(?:(?<![\w)])[-+])?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")
_FILE = re.compile(r"(?:benchmarks|tests|examples|learning|hardware|warp_deform)/[\w/.-]*\w")
_PLACEHOLDER = re.compile(r"\b[A-Z]{2,}\b")
_COMMAND = re.compile(r"warp-deform (?:bench|gradcheck)\b|make (?:demo|test|bench)\b")
_COMMENT = re.compile(r"<!--\s*(?:(from|table):)?(.+?)-->", re.DOTALL)
_UNSEEN = re.compile(r"<!--.*?-->|^```.*?^```|^    [^\n]*$", re.MULTILINE | re.DOTALL)
_QUOTED = re.compile(r"`[^`]+`|\]\([^)]+\)|95\s%\s*(?:Wilson|interval|confidence|\Z)")


@dataclass(frozen=True)
class Figure:
    """A measurement of a page, or a number in a mapped column.

    Attributes:
        numbers: offset in the page and text of each that is compared, or of all if none is
        kind: `compared`, or a key of `WHY`
        unit: whether it is a measurement by its form
        values: what the file says of each
    """

    page: str
    text: str
    numbers: tuple[tuple[int, str], ...]
    kind: str
    unit: bool
    values: tuple[float, ...] = ()

    def __str__(self) -> str:
        return f"{self.page}: {shorten(self.text, 90)}"


@dataclass(frozen=True)
class _Block:
    """A paragraph or a table: its offset and text, what its section names, its comments."""

    start: int
    text: str
    table: bool
    named: str
    comments: tuple[str, ...]


def pages() -> list[Path]:
    """README and the pages of docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def examine(page: str, text: str) -> tuple[list[Figure], list[str]]:
    """Measurements of a page, and what is wrong with them or their sources."""
    figures: list[Figure] = []
    wrong: list[str] = []
    for block in _blocks(page, text, wrong):
        of_block = (_of_table if block.table else _of_text)(page, block, wrong)
        for kind, needed in (("test", "tests/"), ("command", "")):
            if needed not in block.named or not block.named:
                wrong += [f"{each}: no {kind} is named" for each in of_block if each.kind == kind]
        figures += of_block
    return figures, list(dict.fromkeys(wrong))


def numbers_in(text: str) -> list[re.Match[str]]:
    """Measurements of a text."""
    return list(_MEASUREMENT.finditer(_QUOTED.sub(_spaces, text)))


def _spaces(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def _blocks(page: str, text: str, wrong: list[str]) -> Iterator[_Block]:
    """Paragraphs and tables; a comment is the last paragraph's, or the next table's."""
    comments = [(m.start(), m[1], m[2]) for m in _COMMENT.finditer(text)]
    wrong += [
        f"{page}: a comment of another kind:{words}" for _, kind, words in comments if not kind
    ]
    seen = _UNSEEN.sub(_spaces, text)
    heads = [m.span() for m in re.finditer(r"^#+ .*$", seen, re.MULTILINE)]
    ends = [0, *(end for _, end in heads)]
    taken = 0
    for first, last in zip(ends, [*(start for start, _ in heads), len(text)], strict=True):
        names = [name for name in _FILE.findall(seen[first:last]) if not _PLACEHOLDER.search(name)]
        wrong += [
            f"{page} names {each}, which is not there"
            for each in names
            if not (ROOT / each).exists()
        ]
        parts = re.finditer(
            r"(?:^[ ]*\|.*\n?)+|(?:^(?![ ]*\|).*\S.*\n?)+", seen[first:last], re.MULTILINE
        )
        spans = [(first + m.start(), m[0], m[0].lstrip().startswith("|")) for m in parts]
        named = " ".join([*names, *_COMMAND.findall(seen[first:last])])
        for start, part, table in spans:
            later = [s for s, _, is_table in spans if s > start and not is_table]
            until = min(later, default=last)
            earlier = [s for s, _, is_table in spans if s < start and is_table]
            since = max(earlier, default=first)
            mine = tuple(
                words
                for at, kind, words in comments
                if (since <= at < start if table else start <= at < until)
                and (kind == "table") == table
            )
            taken += len(mine)
            yield _Block(start, part, table, named, mine)
    if taken != len(comments):
        wrong.append(f"{page}: {len(comments) - taken} comments belong to no paragraph or table")


def _of_text(page: str, block: _Block, wrong: list[str]) -> list[Figure]:
    matches = numbers_in(block.text)
    printed = [_offsets(match[0], block.start + match.start()) for match in matches]
    unsaid = _unsaid(block.named, block.text)
    if not block.comments:
        return [
            Figure(page, m[0], tuple(n), unsaid, True)
            for m, n in zip(matches, printed, strict=True)
        ]
    tokens = " ".join(block.comments).split()
    wanted = _wanted(tokens)
    held = [number for numbers in printed for number in numbers]
    if len(wanted) != len(held):
        shown = " ".join(text for _, text in held)
        wrong.append(f"{page}: {len(wanted)} expressions for {len(held)} numbers: {shown}")
        return []
    results = iter(
        [_compare(page, each, number, (), wrong) for each, number in zip(wanted, held, strict=True)]
    )
    return [
        _figure(page, m[0], numbers, [next(results) for _ in numbers], True)
        for m, numbers in zip(matches, printed, strict=True)
    ]


def _of_table(page: str, block: _Block, wrong: list[str]) -> list[Figure]:
    figures = []
    specs = [_columns(words) for words in block.comments]
    wrong += [f"{page}: a table's comment without a column" for _, each in specs if 0 in each]
    at = block.start
    for line in block.text.splitlines(keepends=True):
        start, at = at, at + len(line)
        spans = [m.span(1) for m in re.finditer(r"(?<=\|)([^|\n]*)(?=\|)", line)]
        cells = [line[a:b].strip() for a, b in spans]
        head = start == block.start and re.match(r".*\n[\s|:-]+\n", block.text)
        mine = [spec for spec in specs if not head and _applies(page, spec, cells, wrong)]
        if len(mine) > 1 or (specs and not head and not mine and numbers_in(line)):
            wrong.append(f"{page}: {len(mine)} comments are for the row {cells[0]}, {cells[1]}")
        for column, (a, b) in enumerate(spans, 1):
            cell, inside = line[a:b], numbers_in(line[a:b])
            alternatives = mine[0][1].get(column) if mine else None
            if alternatives is None:
                kind = _unsaid(block.named, line)
                figures += [
                    Figure(page, m[0], tuple(_offsets(m[0], start + a + m.start())), kind, True)
                    for m in inside
                ]
                continue
            numbers = _offsets(cell, start + a)
            if not numbers:
                continue
            if alternatives in ([[("", f"{why}*")]] for why in WHY):
                alternatives = [[("", alternatives[0][0][1][:-1])] * len(numbers)]
            wanted = next((each for each in alternatives if len(each) == len(numbers)), None)
            if wanted is None and len(alternatives) == 1 and len(alternatives[0]) > len(numbers):
                wanted = alternatives[0][: len(numbers)]
            if wanted is None:
                wrong.append(f"{page}: {len(numbers)} numbers in {cell.strip()}")
                continue
            results = [
                _compare(page, each, number, cells, wrong)
                for each, number in zip(wanted, numbers, strict=True)
            ]
            figures.append(_figure(page, cell.strip(), numbers, results, bool(inside)))
    return figures


def _unsaid(named: str, text: str) -> str:
    """Why what has no comment is compared with no file."""
    if "tests/" in text:
        return "test"
    return "command" if named else "bare"


_Wanted = tuple[str, str]
"""A source and an expression, or "" and why there is none."""


def _wanted(tokens: list[str], source: str = "") -> list[_Wanted]:
    wanted = []
    for token in tokens:
        if is_source(token):
            source = token
        else:
            wanted.append(("", token[1:]) if token[1:].rstrip("*") in WHY else (source, token))
    return wanted


def _columns(words: str) -> tuple[str, dict[int, list[list[_Wanted]]]]:
    """The first source of a table's comment, and for each column what its cells may be."""
    tokens = words.split()
    first = tokens[0] if is_source(tokens[0]) else ""
    columns: dict[int, list[list[_Wanted]]] = {}
    source, column = "", 0
    for token in tokens:
        if is_source(token):
            source = token
        elif re.fullmatch(r"\d+:", token):
            column = int(token[:-1])
            columns[column] = [[]]
        elif token == "|":
            columns.setdefault(column, [[]]).append([])
        else:
            columns.setdefault(column, [[]])[-1] += _wanted([token], source)
    return first, columns


def _applies(
    page: str, spec: tuple[str, dict[int, list[list[_Wanted]]]], cells: list[str], wrong: list[str]
) -> bool:
    source = spec[0]
    if not source:
        return True
    if not _there(page, source, wrong):
        return False
    return bool(chosen(source, cells))


def _there(page: str, source: str, wrong: list[str]) -> bool:
    missing = [each for each in files_of(source) if not (ROOT / each).is_file()]
    wrong += [f"{page} names {each}, which is not there" for each in missing]
    return not missing


def _offsets(text: str, at: int) -> list[tuple[int, str]]:
    return [(at + m.start(), m[0]) for m in _PRINTED.finditer(text)]


def _compare(
    page: str,
    wanted: _Wanted,
    number: tuple[int, str],
    cells: tuple[str, ...] | list[str],
    wrong: list[str],
) -> float | str:
    """What the file says of a number, or why no file does."""
    source, expression = wanted
    if not source:
        if expression not in WHY:
            wrong.append(f"{page}: {expression} of no file")
            return "bare"
        return expression
    if not _there(page, source, wrong):
        return "bare"
    of = chosen(source, cells)
    try:
        if not of:
            raise ValueError("no such rows")
        value = evaluate(expression, of)
    except ValueError as error:
        wrong.append(f"{page}: {number[1]}: {source}: {error}")
        return "bare"
    if not prints(value, number[1]):
        wrong.append(f"{page}: {number[1]}: {source} has {value:.6g} for {expression}")
    return value


def _figure(
    page: str, text: str, numbers: list[tuple[int, str]], results: list[float | str], unit: bool
) -> Figure:
    why = [each for each in results if isinstance(each, str)]
    held = [(n, v) for n, v in zip(numbers, results, strict=True) if not isinstance(v, str)]
    if not held or not set(why) <= {"setting", "published"}:
        return Figure(page, text, tuple(numbers), why[0], unit)
    return Figure(
        page, text, tuple(n for n, _ in held), "compared", unit, tuple(v for _, v in held)
    )


def _unmapped(text: str) -> int:
    """Cells of a page that begin with a number, but are no measurement and in no mapped column."""
    count = 0
    for block in _blocks("", text, []):
        if not block.table:
            continue
        mapped = {column for words in block.comments for column in _columns(words)[1]}
        for line in block.text.splitlines():
            for column, cell in enumerate(line.split("|")[1:-1], 1):
                begins = re.match(r"\s*[-+]?\d", cell) is not None
                count += begins and column not in mapped and not numbers_in(cell)
    return count


def prints(value: float, number: str) -> bool:
    """Whether a value is printed as this number; half a last digit may go either way."""
    mantissa, _, power = number.replace(",", "").partition("e")
    last = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(value - float(number.replace(",", ""))) <= 0.5 * last * (1 + 1e-6)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write the list of what has no source")
    parser.add_argument("--values", action="store_true", help="what each is compared with")
    options = parser.parse_args()
    every: list[Figure] = []
    for path in pages():
        figures, wrong = examine(str(path.relative_to(ROOT)), path.read_text())
        every += figures
        for line in wrong:
            print("wrong:", line)
    for figure in every:
        if figure.kind != "compared":
            print(f"{figure} ({WHY[figure.kind]})")
        elif options.values:
            print(f"{figure} = {' '.join(f'{each:.6g}' for each in figure.values)}")
    measured = [figure for figure in every if figure.unit]
    for kind, count in Counter(figure.kind for figure in measured).most_common():
        print(f"{count} of {len(measured)} measurements: {WHY.get(kind, 'compared with a file')}")
    cells = sum(len(f.numbers) for f in every if f.kind == "compared" and not f.unit)
    print(f"{cells} further numbers of tables: compared with a file")
    others = Counter({path.name: _unmapped(path.read_text()) for path in pages()})
    counts = ", ".join(f"{page} {count}" for page, count in others.most_common() if count)
    print(f"cells with a number and neither unit nor comment: {counts}")
    if options.write:
        bare = sorted({str(figure) for figure in every if figure.kind == "bare"})
        ALLOWED.write_text("".join(f"{line}\n" for line in bare))


if __name__ == "__main__":
    main()
