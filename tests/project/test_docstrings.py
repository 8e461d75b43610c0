"""Docstrings of the reference have one dialect: what is said of a name stands in a section."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = next(path for path in Path(__file__).resolve().parents if (path / "pyproject.toml").exists())
PAGES = sorted((ROOT / "docs" / "reference").rglob("*.md"))
SECTIONS = {"Args:", "Attributes:", "Returns:", "Raises:", "Yields:", "Examples:"}
SHOWN = sorted(
    {name for page in PAGES for name in re.findall(r"(?m)^::: (\S+)$", page.read_text())}
)


def sources(name: str) -> list[Path]:
    """The file of a module, or all files of a package that are not private."""
    path = ROOT.joinpath(*name.split("."))
    if path.is_dir() and path.name in {"hardware", "learning", "warp_deform"}:
        return [path / "__init__.py"]
    if path.is_dir():
        return sorted(path.glob("*.py"))
    return [path.with_suffix(".py")] if path.with_suffix(".py").exists() else []


FILES = sorted({path for name in SHOWN for path in sources(name)})
WHOLE = sorted(
    path
    for package in ("hardware", "learning", "warp_deform")
    for path in (ROOT / package).rglob("*.py")
)
"""Files whose private names have the dialect, too."""


def names_of(node: ast.ClassDef | ast.FunctionDef) -> set[str]:
    """Parameters of a function; fields of a class, and what its `__init__` takes."""
    if isinstance(node, ast.FunctionDef):
        every = node.args
        return {each.arg for each in [*every.posonlyargs, *every.args, *every.kwonlyargs]}
    fields = {
        each.target.id
        for each in node.body
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    }
    made = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
    return fields.union(*(names_of(each) for each in made))


def outside_of_sections(docstring: str, names: set[str]) -> Iterator[str]:
    """Lines that begin with a name, its shape, its unit and a colon, and stand in no section."""
    inside = False
    for line in docstring.splitlines()[1:]:
        if line.strip() in SECTIONS:
            inside = True
        elif line and not line.startswith(" "):
            inside = False
        entry = re.match(r"`?(\w+)`?(?:, \w+)*(?: \([^)]*\))?(?: \[[^\]]*\])?: ", line)
        if entry and entry[1] in names and not inside:
            yield line


def outside(path: Path, *, private: bool) -> list[str]:
    """Where a file says something of a name outside of sections."""
    return [
        f"{path.name}:{node.lineno} {node.name}: {line}"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef | ast.FunctionDef)
        and (private or not node.name.startswith("_"))
        for line in outside_of_sections(ast.get_docstring(node) or "", names_of(node))
    ]


def test_entries_stand_in_sections() -> None:
    assert [line for path in FILES for line in outside(path, private=False)] == []


def test_entries_of_private_names_stand_in_sections() -> None:
    assert [line for path in WHOLE for line in outside(path, private=True)] == []


def test_an_entry_outside_is_found() -> None:
    wrong = "Run.\n\ntimes (K,) [s]: of the knots\n\nArgs:\n    rate: of it [1/s]\n"
    assert list(outside_of_sections(wrong, {"times", "rate"})) == ["times (K,) [s]: of the knots"]
    assert list(outside_of_sections(wrong, {"rate"})) == []
    assert len(FILES) > 80 and len(WHOLE) > 200
