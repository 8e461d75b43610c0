"""benchmarks/wide_bags.py: cells are made once, and a cell is played on the wide bag."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.benchmark_scripts import benchmark

from warp_deform.tasks import registry


@pytest.fixture
def wide_bags(forgets_tasks: None) -> Iterator[Any]:
    """The script, whose tasks are forgotten afterwards."""
    with benchmark("wide_bags") as module:
        yield module


def test_cells_with_a_line_of_their_sizes_are_left_out(
    wide_bags: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made: list[tuple[str, str, str]] = []

    def cell(task: str, agent: str, rule: str, steps: int, options: Namespace) -> dict[str, Any]:
        made.append((task, agent, rule))
        if len(made) == 3:
            raise KeyboardInterrupt
        sizes = {"demos": options.demos, "steps": steps, "n_episodes": options.episodes}
        return {"task": task, "agent": agent, "stage_rule": rule, **sizes}

    monkeypatch.setattr(wide_bags, "cell", cell)
    out = tmp_path / "rows.jsonl"
    monkeypatch.setattr(sys, "argv", ["wide_bags.py", "--out", str(out)])
    with pytest.raises(KeyboardInterrupt):
        wide_bags.main()
    wide_bags.main()
    wide_bags.main()
    assert len(made) == 25 and len(set(made)) == 24
    steps = {(row["agent"], row["steps"]) for row in map(json.loads, out.read_text().splitlines())}
    assert steps == {("gt-mlp", 20_000), ("gt-mlp-2step", 20_000), ("transporter", 4000)}
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--episodes", "2", "--agents", "gt-mlp"])
    wide_bags.main()
    assert len(made) == 33
    assert {task for task, _, _ in made} == {
        f"bag-items-{items}{wide}" for items in (1, 2) for wide in ("", "-wide")
    }
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--demos", "7", "--tasks", "bag-items-2-wide"])
    wide_bags.main()
    assert [task for task, _, _ in made[33:]] == ["bag-items-2-wide"] * 2


def test_a_cell_is_demonstrated_trained_and_tested_on_the_wide_bag(
    wide_bags: Any, tmp_path: Path
) -> None:
    sizes = Namespace(demos=1, episodes=1, work=tmp_path)
    row = wide_bags.cell("bag-items-1-wide", "gt-mlp", "privileged", 1, sizes)
    assert row["n_episodes"] == 1 and row["steps"] == 1 and row["demonstrated_actions"] >= 2
    assert row["paper_percent"] == 1.7  # of bag-items-1, from one demonstration


def test_a_wide_bag_is_its_neighbour_but_for_the_bag(wide_bags: Any) -> None:
    for wide, narrow in wide_bags.NARROW.items():
        ours, theirs = registry.task(wide), registry.task(narrow)
        assert ours.pushes == 0 < theirs.pushes
        assert ours.bag.ring_stiffness < theirs.bag.ring_stiffness
        assert replace(ours.bag, ring_stiffness=theirs.bag.ring_stiffness) == theirs.bag
        assert type(ours).__bases__ == (type(theirs),)
        own = {name for name in vars(type(ours)) if not name.startswith("_")}
        assert (
            own == {"name", "bag", "pushes", "instruction"}
            and ours.instruction == theirs.instruction
        )
