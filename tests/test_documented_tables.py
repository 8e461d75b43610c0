"""Tables in the documentation of learning are those of the rows that were measured."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = (ROOT / "docs" / "learning.md").read_text()


def measured(name: str) -> tuple[ModuleType, list[dict[str, Any]]]:
    """The benchmark called `name`, and its rows that are checked in."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    lines = (ROOT / "benchmarks" / "results" / "learning" / f"{name}.jsonl").read_text()
    return module, [json.loads(line) for line in lines.splitlines()]


def test_what_each_part_brings() -> None:
    module, rows = measured("ablation")
    assert {row["variant"] for row in rows} <= set(module.VARIANTS)
    for task in {row["task"] for row in rows}:
        of_task = [row for row in rows if row["task"] == task]
        assert len({(row["demos"], row["steps"]) for row in of_task}) == 1
        assert of_task[0]["variant"] == "fast"
        assert module.table(of_task) in DOCUMENT


def test_what_the_grid_of_actions_costs() -> None:
    module, rows = measured("action_grid")
    assert {row["task"] for row in rows} == set(module.TASKS)
    assert module.table([module.Row(**row) for row in rows]) in DOCUMENT
