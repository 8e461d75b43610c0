"""The script that plays tasks with other materials and starts, and what it published."""

from __future__ import annotations

import json
import sys

import pytest
from fixtures.places import ROOT

from warp_deform.tasks.registry import TASKS

sys.path.insert(0, str(ROOT / "benchmarks"))

import hardness

PUBLISHED = ROOT / "benchmarks" / "results" / "hardness.jsonl"


def test_a_changed_task_differs_in_what_was_named_alone() -> None:
    task = hardness.changed("cable-ring", {"cable.fold_limit": 1.1, "max_actions": 3})
    kind = TASKS["cable-ring"]
    assert (task.cable.fold_limit, task.max_actions, task.name) == (1.1, 3, "cable-ring")
    assert task.cable.beads == kind.cable.beads and task.solver == kind.solver
    assert kind.cable.fold_limit == 0.85 and kind.max_actions == 20, "the registry keeps its own"
    with pytest.raises(AttributeError, match="colour_of_dreams"):
        hardness.changed("cable-ring", {"colour_of_dreams": 1})


def test_what_is_changed_is_what_is_played() -> None:
    """The block is solved by one action, unless its tolerance leaves no room."""
    row = hardness.measure("block-notarget", "scripted", {}, 20_000, 4)
    assert (row.successes, row.mean_actions_solved, row.changed) == (4, 1.0, "nothing")
    strict = {"position_tolerance": 0.0}
    row = hardness.measure("block-notarget", "scripted", strict, 20_000, 4)
    assert (row.successes, row.mean_actions_solved) == (0, None)
    assert row.changed == "position_tolerance=0" and row.ends == {"not solved": 4}


def test_misplaced_things_lie_beside_their_places() -> None:
    """The block may lie 1 cm off."""
    rows = [hardness.measure("block-notarget", "scripted", {}, 20_000, 4, mm) for mm in (0.5, 60.0)]
    assert [row.successes for row in rows] == [4, 0]
    assert [row.misplace_mm for row in rows] == [0.5, 60.0] and rows[0].changed == "nothing"


def test_rows_that_are_published_say_what_was_changed() -> None:
    rows = [hardness.Row(**json.loads(line)) for line in PUBLISHED.read_text().splitlines()]
    assert all(row.changed == hardness.words(row.settings) for row in rows)
    keys = [
        (row.task, row.by, row.changed, row.first_seed, row.attempts, row.misplace_mm)
        for row in rows
    ]
    assert len(set(keys)) == len(keys)
