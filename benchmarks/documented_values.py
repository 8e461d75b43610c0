"""What a number in a page is compared with: an expression over chosen rows of a file of results.

    benchmarks/results/twin.jsonl[agent=planner,goal=1|4]     a file, and which of its rows
    count(success)    100*interval[0]    mean(actions[success])    what their columns say

Rows are those of CSV and JSON lines, and every object in a JSON file, which also has the `key` that
it stands under; `FILE+FILE` has each row of the first with every row of its task in the second
(choose one of these before summing), whose columns are also called `other_NAME`: where both have
one, its name alone is the first's. Conditions compare names as they are printed:
`task=cable-shape|cable-line`, `variant~8,000` for a part of it; `$2` is the second cell of the
table's row, and `$2.1` its part before the first comma. An expression has Python's syntax without
spaces: columns by name, their entries (`interval[0]`, `failures.other`), the rows that a mask keeps
(`actions[success]`), arithmetic, comparisons and `FUNCTIONS`. It comes to one number.
"""

from __future__ import annotations

import ast
import csv
import json
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from learning.evaluation.clustered import clustered_mean, clustered_rate

ROOT = Path(__file__).resolve().parent.parent

Row = dict[str, Any]

_FILE = r"[\w./-]+\.(?:csv|jsonl|json)"
_SOURCE = re.compile(rf"(?P<file>{_FILE})(?:\+(?P<other>{_FILE}))?(?:\[(?P<chosen>[^\]]+)\])?")
_CELL = re.compile(r"\$(\d)(?:\.(\d))?")
_PRINTED = {"gt-state-mlp": "gt-mlp", "gt-state-mlp-2-step": "gt-mlp-2step"}
"""Names that pages print otherwise than files write them."""


def is_source(token: str) -> bool:
    """Whether a token of a comment names a file, and not an expression."""
    return _SOURCE.fullmatch(token) is not None


def files_of(source: str) -> list[str]:
    """The files that a source names, relative to the repository."""
    match = _SOURCE.fullmatch(source)
    assert match is not None
    return [each for each in (match["file"], match["other"]) if each]


def name(value: Any) -> str:
    """A value as conditions compare it: lower case, hyphens, no marks, commas and backticks."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return _slug(value if isinstance(value, str) else json.dumps(value))


@cache
def _slug(text: str) -> str:
    bare = re.sub(r"[`*¹²³,]", "", text)
    slug = re.sub(r"[\s_]+", "-", bare.strip().lower())
    return _PRINTED.get(slug, slug)


def chosen(source: str, cells: Sequence[str] = ()) -> list[Row]:
    """Rows of a source; none where a condition on a cell of the page does not hold."""
    match = _SOURCE.fullmatch(source)
    assert match is not None
    kept = rows(ROOT / match["file"])
    if match["other"]:
        others = rows(ROOT / match["other"])
        kept = [
            _joined(row, each) for row in kept for each in others if row["task"] == each["task"]
        ]
    for condition in (match["chosen"] or "").split(",") if match["chosen"] else []:
        left, relation, right = re.split(r"([=~])", condition, maxsplit=1)
        wanted = [name(_filled(each, cells)) for each in right.split("|")]
        holds = _equal if relation == "=" else _part
        if left.startswith("$"):
            kept = kept if holds(name(_filled(left, cells)), wanted) else []
        else:
            kept = [row for row in kept if left in row and holds(name(row[left]), wanted)]
    return kept


def _joined(row: Row, other: Row) -> Row:
    """Both rows; a name that both have is the first's, and `other_NAME` the second's."""
    return {**other, **{f"other_{key}": value for key, value in other.items()}, **row}


def _equal(value: str, wanted: list[str]) -> bool:
    return value in wanted


def _part(value: str, wanted: list[str]) -> bool:
    return any(each and each in value for each in wanted)


def _filled(text: str, cells: Sequence[str]) -> str:
    match = _CELL.fullmatch(text)
    if match is None:
        return text
    cell = cells[int(match[1]) - 1]
    parts = cell.split(", ")
    return cell if match[2] is None else (*parts, "", "")[int(match[2]) - 1]


@cache
def rows(file: Path) -> list[Row]:
    """The rows of CSV or JSON lines, or all objects of a JSON file."""
    if file.suffix == ".csv":
        with file.open(newline="") as lines:
            return [{k: _number(v) for k, v in row.items()} for row in csv.DictReader(lines)]
    if file.suffix == ".jsonl":
        return [json.loads(line) for line in file.read_text().splitlines() if line]
    return list(_objects(json.loads(file.read_text()), ""))


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def _objects(value: Any, key: str) -> Iterator[Row]:
    if isinstance(value, dict):
        yield {**value, "key": key}
        for inner, each in value.items():
            yield from _objects(each, inner)
    elif isinstance(value, list):
        for each in value:
            yield from _objects(each, key)


def evaluate(expression: str, of: list[Row]) -> float:
    """The number that an expression comes to.

    Raises:
        ValueError: it is none, names what is not there, or comes to several numbers
    """
    try:
        value = _value(ast.parse(expression, mode="eval").body, of)
        values = set(np.atleast_1d(np.asarray(value, dtype=float)).tolist())
    except (SyntaxError, KeyError, IndexError, TypeError) as error:
        raise ValueError(f"{expression} of {len(of)} rows: {error!r}") from error
    if len(values) != 1:
        raise ValueError(f"{expression} is {len(values)} different numbers")
    return values.pop()


def _value(node: ast.expr, of: list[Row]) -> Any:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name):
        return _column([row[node.id] for row in of])
    if isinstance(node, ast.Attribute):
        return _column([each[node.attr] for each in _value(node.value, of)])
    if isinstance(node, ast.Subscript):
        inner, index = _value(node.value, of), _value(node.slice, of)
        if isinstance(index, np.ndarray):
            return inner[index.astype(bool)]
        return _column([each[index] for each in inner])
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_value(node.operand, of)
    if isinstance(node, ast.BinOp):
        return _ARITHMETIC[type(node.op)](_value(node.left, of), _value(node.right, of))
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        compare = _COMPARISONS[type(node.ops[0])]
        return compare(_value(node.left, of), _value(node.comparators[0], of))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        if node.func.id == "rows":
            return len(of)
        return FUNCTIONS[node.func.id](*(_value(each, of) for each in node.args))
    raise ValueError(f"an expression may not have {type(node).__name__}")


def _column(values: list[Any]) -> np.ndarray:
    """Values (rows,); numbers as float64, all else as objects."""
    if all(isinstance(each, (int, float)) for each in values):
        return np.array(values, dtype=float)
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


def _half_width(column: np.ndarray) -> float:
    """1.96 standard errors of a mean."""
    return float(1.96 * np.std(column, ddof=1) / len(column) ** 0.5)


def _wilson(end: str) -> Callable[[Any, Any], float]:
    def of(solved: Any, attempts: Any) -> float:
        counts = (int(np.atleast_1d(each)[0]) for each in (solved, attempts))
        return float(100 * getattr(binomtest(*counts).proportion_ci(method="wilson"), end))

    return of


_ARITHMETIC: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.BitAnd: operator.and_,
}
_COMPARISONS: dict[type, Callable[..., Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.Gt: operator.gt,
}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "mean": np.mean,
    "median": np.median,
    "least": np.min,
    "most": np.max,
    "sum": np.sum,
    "sort": np.sort,
    "count": lambda column: int(np.sum(column.astype(bool))),
    "error": _half_width,
    "low": _wilson("low"),
    "high": _wilson("high"),
    "rate_low": lambda solved, group: clustered_rate(solved.tolist(), group.tolist())[0],
    "rate_high": lambda solved, group: clustered_rate(solved.tolist(), group.tolist())[1],
    "group_error": lambda values, group: clustered_mean(values.tolist(), group.tolist())[1],
}
"""Of columns; besides, `rows()` is how many rows there are. Wilson's interval and those of
clusters are in %, `error` is 1.96 standard errors."""
