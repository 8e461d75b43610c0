"""The script behind docs/convergence.md."""

from __future__ import annotations

import sys

import pytest
from fixtures.places import ROOT

from warp_deform.tasks.registry import TASKS

sys.path.insert(0, str(ROOT / "benchmarks"))

import convergence

PUBLISHED = convergence.read(ROOT / "benchmarks" / "results" / "convergence.jsonl")


def test_a_finer_task_differs_in_its_substep_alone() -> None:
    task, finer = TASKS["block-notarget"], convergence.finer(TASKS["block-notarget"], 4)
    assert finer.solver.dt == task.solver.dt / 4 and finer.name == task.name
    assert TASKS["block-notarget"] is task, "the registry keeps its own"
    rows = [convergence.measure("block-notarget", divisor, 2) for divisor in (1, 4)]
    for row in rows:
        assert row.successes == row.attempts == 2 and row.guards == 0
        assert (row.actions, row.actions_error) == (1.0, 0.0)
        assert row.height == pytest.approx(20.0, abs=0.2)
    assert rows[0].substep == 4 * rows[1].substep


def test_what_is_published_has_three_substeps_and_is_in_the_page() -> None:
    keys = [(row.task, row.divisor) for row in PUBLISHED]
    tasks = {row.task for row in PUBLISHED}
    assert {name for name in TASKS if "cable" in name} < tasks
    assert sorted(keys) == sorted((task, n) for task in tasks for n in convergence.DIVISORS)
    # a bag costs as much as ten cables, so it is played less often: but as often with each substep
    assert len({(row.task, row.attempts) for row in PUBLISHED}) == len(tasks)
    assert min(row.attempts for row in PUBLISHED) >= 24
    assert not any(row.guards for row in PUBLISHED)
    page = (ROOT / "docs" / "convergence.md").read_text()
    assert convergence.table(PUBLISHED) in page
