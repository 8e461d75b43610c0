"""Tables in the documentation are those of the rows that were measured."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
from fixtures.places import ROOT

DOCUMENT = (ROOT / "docs" / "learning.md").read_text()


def measured(
    name: str, folder: str = "results/learning"
) -> tuple[ModuleType, list[dict[str, Any]]]:
    """The benchmark called `name`, and its rows that are checked in."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    lines = (ROOT / "benchmarks" / folder / f"{name}.jsonl").read_text()
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


def test_how_hard_the_tasks_are_and_what_bags_enclose() -> None:
    module, lines = measured("demonstrators", "results")
    rows = [module.Row(**line) for line in lines]
    page = (ROOT / "docs" / "hardness.md").read_text()
    assert module.hardness(rows) in page and module.bags(rows) in page
    assert all(row.enclosed is not None for row in rows if row.task.startswith("bag-items"))


def test_rows_of_neighbouring_seeds_count_as_one() -> None:
    module, lines = measured("demonstrators", "results")
    row = module.Row(**lines[0])
    few = replace(row, first_seed=0, attempts=10, successes=5, mean_actions_solved=2.0, enclosed=4)
    more = replace(
        few,
        first_seed=10,
        attempts=30,
        successes=15,
        mean_actions=8.0,
        mean_actions_solved=4.0,
        enclosed=10,
    )
    (both,) = module.pooled([more, few])
    assert (both.attempts, both.successes, both.enclosed) == (40, 20, 14)
    assert both.mean_actions_solved == pytest.approx(3.5)
    assert both.mean_actions == pytest.approx((10 * few.mean_actions + 30 * 8.0) / 40)
    for wrong in (replace(more, first_seed=11), replace(more, first_seed=9)):
        with pytest.raises(SystemExit, match="missing, or twice"):
            module.pooled([few, wrong])
