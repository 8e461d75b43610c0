"""What a policy remembers, by itself and behind the chooser that drives a robot."""

from __future__ import annotations

import dataclasses
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fixtures.franka_episodes import GOAL, TASK, chain

from hardware.arm.pick_place import PickPlaceAction, PickPlaceOutcome
from hardware.choosers.simple import PolicyChooser
from hardware.episodes.episode import Observation
from learning.data.batches import task_lifts
from learning.models.traced import TracedConfig
from learning.models.transporter import PRESETS
from learning.policy.memory import MISSED, PUT_DOWN, REPEATED, RESTING, Memory
from learning.policy.policy import AgentDescription, ImagePolicy, make_agent
from learning.runs.folder import RunFolder

PLACES = np.linspace([0.3, 0.0], [0.5, 0.2], 6)


def test_what_failed_is_tried_elsewhere_and_what_was_put_down_rests() -> None:
    memory = Memory()
    assert memory.avoid(changed=True) == []
    for n, pick in enumerate(PLACES[:3]):
        memory.chose(pick, pick + 0.1)
        discs = memory.avoid(changed=False)
        assert [tuple(xy) for xy, _ in discs] == [tuple(xy) for xy in PLACES[: n + 1]]
        assert {reach for _, reach in discs} == {MISSED}
    for _ in range(2):  # asking twice changes nothing
        discs = memory.avoid(changed=True)
        assert len(discs) == 1 and discs[0][1] == PUT_DOWN
        np.testing.assert_array_equal(discs[0][0], PLACES[2] + 0.1, "the last one's doing")
        assert memory.avoid(changed=False) == discs
    for pick in PLACES[3:]:
        memory.chose(pick, pick + 0.1)
        discs = memory.avoid(changed=True)
    np.testing.assert_array_equal([xy for xy, _ in discs], PLACES[-RESTING:] + 0.1)


def done(memory: Memory, pick: np.ndarray, place: np.ndarray) -> list[tuple[float, ...]]:
    """Do an action that changes the picture; picks that are avoided since, for being repeated."""
    memory.chose(pick, place)
    avoided = memory.avoid(changed=True)
    return [tuple(xy) for xy, _ in avoided[min(len(memory._done), RESTING) :]]


def test_an_action_that_was_undone_and_done_again_is_not_done_a_third_time() -> None:
    left, right = np.array([0.3, 0.0]), np.array([0.6, 0.1])
    out = np.array([0.05, 0.0])
    near = np.array([0.0, 0.9 * REPEATED])
    memory = Memory()
    assert done(memory, left, left - out) == done(memory, right, right + out) == []
    assert done(memory, left + near, left - out) == [tuple(left + near)]
    assert done(memory, right, right + out + near) == [tuple(left + near), tuple(right)]
    assert {reach for _, reach in memory.avoid(changed=False)[RESTING:]} == {REPEATED}
    assert done(memory, left + 3 * out, left) == [tuple(right)]  # what was repeated rests, too
    assert done(memory, right - 3 * out, right) == []


@pytest.mark.parametrize("other", ["pick", "place", "undone"])
def test_only_the_same_action_done_counts_as_repeated(other: str) -> None:
    pick, place, away = np.array([0.3, 0.0]), np.array([0.4, 0.1]), np.array([0.0, 1.1 * REPEATED])
    memory = Memory()
    done(memory, pick, place)
    if other == "undone":  # it changed nothing: that pick missed
        memory.chose(pick, place)
        assert [reach for _, reach in memory.avoid(changed=False)] == [MISSED, PUT_DOWN]
        return
    again = (pick + away, place) if other == "pick" else (pick, place + away)
    assert done(memory, *again) == []


@pytest.fixture(params=["goal-split", "traced"])
def chooser(request: pytest.FixtureRequest, tmp_path: Path) -> PolicyChooser:
    """An untrained policy of the robot's task, small."""
    small = dataclasses.replace(PRESETS["fast"], width=0.0625, crop=16, lifts=task_lifts(TASK))
    sizes = {"goal-split": small, "traced": TracedConfig(channels=8, members=1)}
    config = dataclasses.asdict(sizes[request.param])
    description = AgentDescription(task=TASK.name, agent=request.param, config=config)
    run = RunFolder(tmp_path)
    run.path.joinpath("snapshots").mkdir()
    weights = make_agent(description).state_dict()
    record = {"agent": dataclasses.asdict(description)}
    return PolicyChooser(run.write_snapshot(0, weights, record))


Avoided = list[list[tuple[np.ndarray, float]]]


@pytest.fixture
def avoided(monkeypatch: pytest.MonkeyPatch) -> Avoided:
    """What every later proposal was told not to pick."""
    proposals: Avoided = []
    act = ImagePolicy.act

    def spied(*args: Any, avoid: list[tuple[np.ndarray, float]]) -> np.ndarray:
        proposals.append(list(avoid))
        return act(*args, avoid=avoid)

    monkeypatch.setattr(ImagePolicy, "act", spied)
    return proposals


def chosen(
    chooser: PolicyChooser, x: float, last: PickPlaceOutcome | None = None
) -> PickPlaceAction:
    """What it does about a straight chain at `x`."""
    mask = TASK.mask(chain(x))
    view = np.zeros((*mask.shape, 3), np.uint8)
    action = chooser.choose(Observation(0, view, mask, GOAL, last))
    assert action is not None
    return action


def test_a_robots_policy_remembers_as_one_in_simulation(
    chooser: PolicyChooser, avoided: Avoided
) -> None:
    tried = [chosen(chooser, 0.45) for _ in range(4)]
    gaps = [np.subtract(a.pick_xy, b.pick_xy) for a, b in combinations(tried, 2)]
    assert np.linalg.norm(gaps, axis=1).min() >= MISSED
    chosen(chooser, 0.52, PickPlaceOutcome.PLACED)
    discs = avoided[-1]
    ((xy, reach),) = discs
    assert xy == pytest.approx(tried[-1].place_xy, abs=1e-9) and reach == PUT_DOWN
    chooser.reset()
    assert chosen(chooser, 0.45) == tried[0] and not avoided[-1]


@pytest.mark.parametrize("outcome", [PickPlaceOutcome.MISSED_GRASP, PickPlaceOutcome.OBSTRUCTED])
def test_a_chain_that_was_only_pushed_keeps_what_failed(
    outcome: PickPlaceOutcome, chooser: PolicyChooser, avoided: Avoided
) -> None:
    first = chosen(chooser, 0.45)
    chosen(chooser, 0.46, outcome)
    ((xy, reach),) = avoided[-1]
    assert reach == MISSED
    np.testing.assert_allclose(xy, first.pick_xy, atol=1e-9)


def test_a_pull_along_the_chain_counts_and_noise_does_not(
    chooser: PolicyChooser, avoided: Avoided
) -> None:
    lying = chain(0.45)
    mask = TASK.mask(lying)
    edges = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
    noisy = mask ^ (edges & (np.random.default_rng(0).random(mask.shape) < 0.3))
    pulled = TASK.mask(np.add(lying, (0.0, 0.01, 0.0)))
    view, reaches = np.zeros((*mask.shape, 3), np.uint8), []
    for each in (mask, noisy, pulled):
        chooser.choose(Observation(0, view, each, GOAL, PickPlaceOutcome.PLACED))
        reaches.append([reach for _, reach in avoided[-1]])
    assert reaches == [[], [MISSED], [PUT_DOWN]]


def test_a_pick_without_finger_clearance_is_passed_over_unless_there_is_no_other(
    chooser: PolicyChooser, avoided: Avoided, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = chosen(chooser, 0.45)
    asked: list[tuple[float, float]] = []

    def after(looks: int) -> None:
        def room(mask: np.ndarray, action: PickPlaceAction, **_: Any) -> bool:
            asked.append(action.pick_xy)
            return len(asked) > looks

        asked.clear()
        chooser.reset()
        monkeypatch.setattr("hardware.choosers.simple.has_finger_clearance", room)

    after(2)
    action = chosen(chooser, 0.45)
    assert asked[0] == first.pick_xy and action.pick_xy == asked[2] and len(set(asked)) == 3
    after(100)
    assert chosen(chooser, 0.45) == first and len(set(asked)) == 8
