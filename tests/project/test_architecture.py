"""docs/architecture.md draws the floors of the layering test, and names what exists."""

from __future__ import annotations

import ast
import importlib
import re
from functools import reduce

import pytest
from fixtures.places import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text()
WIDE, NARROW = 85, 41
"""Characters between the walls of `warp_deform`, and of each of the two packages above it."""
DOTTED = sorted(set(re.findall(r"`((?:warp_deform|learning|hardware)(?:\.\w+)+)`", PAGE)))
PATHS = sorted(set(re.findall(r"`((?:warp_deform|learning|hardware|tests)/[\w/.]+)`", PAGE)))


def floors() -> dict[str, list[str]]:
    """`FLOORS` of the layering test, read from its source."""
    (source,) = (ROOT / "tests").rglob("test_layering.py")
    values = {
        target.id: node.value
        for node in ast.parse(source.read_text()).body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    floors_of: dict[str, list[str]] = ast.literal_eval(values["FLOORS"])
    return floors_of


def box(rows: list[str], width: int, *, arrow: bool) -> list[str]:
    """Rows between walls, and an arrow out of the floor where there is one."""
    bottom = "─" * width
    if arrow:
        bottom = f"{bottom[: width // 2]}┬{bottom[width // 2 + 1 :]}"
    return [f"┌{'─' * width}┐", *(f"│ {row:<{width - 1}}│" for row in rows), f"└{bottom}┘"]


def drawing(floors: dict[str, list[str]]) -> str:
    """The three packages, `warp_deform` below the other two; a line a floor."""
    rows = {name: [" · ".join(each.split()) for each in floors[name]] for name in floors}
    upper = max(len(rows["learning"]), len(rows["hardware"]))
    pair = [
        box(rows[name] + [""] * (upper - len(rows[name])), NARROW, arrow=True)
        for name in ("learning", "hardware")
    ]
    step = f"{' ' * (NARROW // 2 + 1)}{{0}}{' ' * (NARROW + 2)}{{0}}"
    lines = [f"{'learning':<{NARROW + 3}}hardware", *map(" ".join, zip(*pair, strict=True))]
    lines += [step.format("▼"), "warp_deform", *box(rows["warp_deform"], WIDE, arrow=False)]
    return "\n".join(line.rstrip() for line in lines)


def test_the_drawing_is_that_of_the_floors() -> None:
    right = drawing(floors())
    (shown,) = re.findall(r"^```text\n(.*?)\n```$", PAGE, re.MULTILINE | re.DOTALL)
    assert shown == right, f"draw this:\n{right}"


@pytest.mark.parametrize("package", floors())
def test_every_room_has_a_line_that_says_what_it_holds(package: str) -> None:
    table = PAGE.split(f"\n### {package}\n")[1].split("\n#")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", table, re.MULTILINE)
    named = [room for floor in floors()[package] for room in floor.split()]
    assert [room for room, _ in rows] == [room for room in named if room != "__main__"]
    assert all(len(says) > 10 for _, says in rows)


@pytest.mark.parametrize("name", DOTTED)
def test_a_name_is_there(name: str) -> None:
    """A dotted name leads from the longest module in it to something in that module."""
    parts = name.split(".")
    while True:
        try:
            module = importlib.import_module(".".join(parts))
            break
        except ModuleNotFoundError:
            parts.pop()
    reduce(getattr, name.split(".")[len(parts) :], module)


@pytest.mark.parametrize("path", PATHS)
def test_a_path_is_there(path: str) -> None:
    assert (ROOT / path).exists()


def test_a_changed_floor_changes_the_drawing() -> None:
    before = floors()
    after = {**before, "learning": [*before["learning"][1:], before["learning"][0]]}
    assert drawing(after) != drawing(before)
    assert len(DOTTED) > 30 and len(PATHS) > 10
    assert {len(line) for line in drawing(before).splitlines() if line[0] in "┌│└"} == {87}
