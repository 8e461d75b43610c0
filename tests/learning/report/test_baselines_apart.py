"""Runs of baselines that were trained in other ways are not pooled, named or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.evaluated_runs import AGENT, SCHEDULE, write_run

from learning.evaluation.paper_results import read_paper
from learning.report.cells import pool
from learning.report.read import read_runs
from warp_deform.errors import InputError


def cells(*paths: Path) -> list[Any]:
    return pool(read_runs(paths)[0], read_paper())


def test_a_place_network_s_steps_count_where_there_is_one(tmp_path: Path) -> None:
    """Runs before there was a choice do not name it; only 2-Step has such a network."""
    faster = {**SCHEDULE, "place_lr": 5.0}
    for agent in ("gt-mlp", "gt-mlp-2step"):
        trained = {"agent": {**AGENT, "agent": agent}}
        write_run(tmp_path / agent / "a", agent=agent, trained=trained)
        write_run(tmp_path / agent / "b", seed=1, agent=agent, trained=trained, schedule=faster)
    assert [cell.seeds for cell in cells(tmp_path / "gt-mlp")] == [(0, 1)]
    with pytest.raises(InputError, match="differ in schedule"):
        cells(tmp_path / "gt-mlp-2step")


def test_how_long_gaussians_weigh_the_same_counts(tmp_path: Path) -> None:
    trained = {"agent": {**AGENT, "agent": "gt-mlp"}}
    for name, seed, changes in (("a", 0, {}), ("b", 1, {"even": 0.0}), ("c", 2, {"even": 0.5})):
        schedule = {**SCHEDULE, **changes}
        write_run(tmp_path / name, seed=seed, agent="gt-mlp", trained=trained, schedule=schedule)
    with pytest.raises(InputError, match="differ in schedule"):
        cells(tmp_path)
    assert [cell.seeds for cell in cells(tmp_path / "a", tmp_path / "b")] == [(0, 1)]


def test_how_cosines_are_seen_counts(tmp_path: Path) -> None:
    for seed, seen in enumerate(({}, {"cosines_less_one": False}, {"cosines_less_one": True})):
        agent = {**AGENT, "agent": "gt-mlp", "config": {**AGENT["config"], **seen}}
        write_run(tmp_path / str(seed), seed=seed, agent="gt-mlp", trained={"agent": agent})
    with pytest.raises(InputError, match="differ in agent"):
        cells(tmp_path)
    assert [cell.seeds for cell in cells(tmp_path / "0", tmp_path / "1")] == [(0, 1)]
