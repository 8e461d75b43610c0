"""Kinds of failure, told from actions, outcomes and the opening of a bag."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from learning.evaluation.failures import (
    bag_holds_items,
    bag_opening,
    closed,
    failure,
    puts_back,
)
from learning.evaluation.summary import FAILURES
from warp_deform.tasks.bag_items import BagItems1
from warp_deform.tasks.cable_line import CableLineNotarget
from warp_deform.worlds.loop import EpisodeRun


def action(pick: tuple[float, float], place: tuple[float, float], lift: float = 0.05) -> np.ndarray:
    return np.array([*pick, 0.0, *place, 0.0, lift])


THERE = action((0.5, 0.0), (0.6, 0.2))
BACK = action((0.61, 0.21), (0.5, 0.02))
ELSEWHERE = action((0.3, -0.3), (0.4, 0.4))


@pytest.mark.parametrize(
    ("actions", "expected"),
    [
        ([THERE, BACK, THERE], True),
        ([THERE, BACK], False),
        ([THERE, THERE, THERE], False),
        ([THERE, BACK, ELSEWHERE, BACK], False),
        ([THERE, ELSEWHERE] * 3, False),
        ([], False),
    ],
)
def test_actions_that_put_back(actions: list[np.ndarray], expected: bool) -> None:
    assert puts_back(actions) is expected


def test_an_opening_that_was_closed_for_good() -> None:
    assert closed([0.6, 0.3, 0.3], [True, True])
    assert not closed([0.6, 0.3, 0.5], [True, True]), "it was opened again"
    assert not closed([0.6, 0.3], [False]), "a carry closes any bag"
    assert closed([0.6, 0.3, 0.1], [True, False])
    assert not closed([0.6], [])


class _Bag(BagItems1):
    covered, inside = False, False

    def hidden(self, *_: Any) -> bool:
        return self.covered

    def inside_bag(self, *_: Any) -> bool:
        return self.inside


@pytest.mark.parametrize(
    ("expected", "lifts", "outcomes", "openings", "covered", "inside"),
    [
        ("missed grasp", [0.05, 0.05], ["missed", "placed"], [0.4] * 3, True, False),
        ("missed grasp", [0.05, 0.05], ["unreachable", "missed"], [0.4] * 3, True, False),
        ("destructive bag action", [0.05, 0.3], ["placed"] * 2, [0.6, 0.3, 0.3], True, False),
        ("item not enclosed", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], True, False),
        ("opening covered", [0.05, 0.05], ["placed"] * 2, [0.3] * 3, True, False),
        ("opening covered", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], True, True),
        ("other", [0.3, 0.4], ["placed"] * 2, [0.6, 0.6, 0.1], False, True),
    ],
)
def test_failures_of_bags(
    expected: str,
    lifts: list[float],
    outcomes: list[str],
    openings: list[float],
    covered: bool,
    inside: bool,
) -> None:
    task = _Bag()
    task.covered, task.inside = covered, inside
    snapshot = SimpleNamespace(body_q=np.zeros((1, 7)))
    episode = SimpleNamespace(physics_ok=True, snapshot=snapshot, layout=None)
    worlds: Any = SimpleNamespace(task=task, episodes={0: episode})
    run: EpisodeRun[Any] = EpisodeRun(0, np.random.default_rng(0))
    run.actions = [action((0.3, 0.1 * n), (0.6, 0.0), lift) for n, lift in enumerate(lifts)]
    run.outcomes, run.ended = outcomes, "not solved"
    assert failure(worlds, 0, run, openings) == expected and expected in FAILURES
    assert bag_holds_items(worlds, 0) is inside
    run.ended = "solved"
    assert failure(worlds, 0, run, openings) is None
    run.ended, episode.physics_ok = "physics: stretch", False
    assert failure(worlds, 0, run, openings) == "physics"


def test_failures_without_a_bag() -> None:
    episode = SimpleNamespace(physics_ok=True, snapshot=None, layout=None)
    worlds: Any = SimpleNamespace(task=CableLineNotarget(), episodes={0: episode})
    assert bag_opening(worlds, 0) is None and bag_holds_items(worlds, 0) is None
    run: EpisodeRun[Any] = EpisodeRun(0, np.random.default_rng(0))
    run.actions, run.outcomes = [THERE, BACK, THERE], ["placed"] * 3
    run.ended = "not solved in 3 actions"
    assert failure(worlds, 0, run, [None] * 4) == "back and forth"
    run.actions = [ELSEWHERE] * 3
    assert failure(worlds, 0, run, [None] * 4) == "other"
