"""benchmarks/goal_bends.py: how far a goal turns, and who reaches which quarter of them."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

from goal_bends import TASK, demonstrated, keep, quarters, turn_deg

from warp_deform.collecting.goals import load_goal
from warp_deform.collecting.make_goals import make_goals
from warp_deform.episodes import EpisodeReader


def arc(degrees: float, *, turned: float = 0.0) -> np.ndarray:
    """A chain of 90 beads along a circle whose tangent turns by so many degrees."""
    angle = np.radians(np.linspace(0.0, degrees, 90)) + turned
    return np.cumsum(0.005 * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)


def test_a_turn_is_the_arcs_wherever_the_chain_begins_and_whichever_way_it_goes() -> None:
    for degrees in (0.0, 40.0, 170.0, 300.0):
        for turned in (0.0, 3.0, -2.5):
            for points in (arc(degrees, turned=turned), arc(degrees, turned=turned)[::-1]):
                assert abs(turn_deg(points) - degrees * 84 / 89) < 0.1


def test_quarters_hold_every_episode_once_and_the_most_bent_come_last() -> None:
    turns = {seed: float((7 * seed) % 10) for seed in range(10)}
    rows = list(quarters(turns, {seed: turns[seed] < 5 for seed in turns}))
    assert [row["n_episodes"] for row in rows] == [3, 3, 2, 2]
    assert [row["n_success"] for row in rows] == [3, 2, 0, 0]
    edges = [edge for row in rows for edge in (row["least_deg"], row["most_deg"])]
    assert edges == sorted(edges)


def test_who_plays_again_has_new_rows_and_others_keep_theirs(tmp_path: Path) -> None:
    file = tmp_path / "bends.jsonl"
    for by, solved in (("mpc", 1), ("scripted", 2), ("mpc", 3)):
        keep(file, [{"by": by, "quarter": k, "n_success": solved} for k in (1, 2)])
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(row["by"], row["n_success"]) for row in rows] == [("scripted", 2)] * 2 + [
        ("mpc", 3)
    ] * 2


def test_a_demonstrator_plays_for_the_goals_that_it_is_given(tmp_path: Path) -> None:
    make_goals(TASK, tmp_path, count=2, seed=100_000, kind="constructed", robot="ur5", workers=1)
    reader = EpisodeReader(tmp_path)
    goals = {10_000 + k: load_goal(reader.path(seed)) for k, seed in enumerate(reader.seeds)}
    solved = demonstrated("scripted", goals)
    assert solved.keys() == goals.keys() and any(solved.values())
    for seed, goal in goals.items():
        assert goal.targets is not None
        goals[seed] = replace(goal, targets=goal.targets + 1.0)
    assert not any(demonstrated("scripted", goals).values())
