"""Tables of what makes `fast` learn are those of the rows that were measured."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_documented_tables_are_those_of_the_rows() -> None:
    spec = importlib.util.spec_from_file_location("ablation", ROOT / "benchmarks" / "ablation.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    lines = (ROOT / "benchmarks" / "results" / "learning" / "ablation.jsonl").read_text()
    rows = [json.loads(line) for line in lines.splitlines()]
    assert {row["variant"] for row in rows} <= set(module.VARIANTS)
    document = (ROOT / "docs" / "learning.md").read_text()
    for task in {row["task"] for row in rows}:
        of_task = [row for row in rows if row["task"] == task]
        assert len({(row["demos"], row["steps"]) for row in of_task}) == 1
        assert of_task[0]["variant"] == "fast"
        assert module.table(of_task) in document
