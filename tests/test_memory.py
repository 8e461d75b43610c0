"""What a policy remembers, by itself and behind the chooser that drives a robot."""

from __future__ import annotations

import dataclasses
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from franka_episodes import GOAL, TASK, chain

from hardware.choosers import PolicyChooser
from hardware.episode import Observation
from hardware.pick_place import PickPlaceAction
from learning.memory import MISSED, PUT_DOWN, RESTING, Memory
from learning.models.transporter import PRESETS
from learning.policy import AgentDescription, ImagePolicy, make_agent
from learning.snapshots import RunFolder

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
        discs = memory.avoid(changed=False)
    for pick in PLACES[3:]:
        memory.chose(pick, pick + 0.1)
        discs = memory.avoid(changed=True)
    np.testing.assert_array_equal([xy for xy, _ in discs], PLACES[-RESTING:] + 0.1)


@pytest.fixture
def chooser(tmp_path: Path) -> PolicyChooser:
    """An untrained policy of the robot's task, small."""
    config = dataclasses.asdict(dataclasses.replace(PRESETS["fast"], width=0.0625, crop=16))
    description = AgentDescription(task=TASK.name, agent="goal-split", config=config)
    run = RunFolder(tmp_path)
    run.path.joinpath("snapshots").mkdir()
    weights = make_agent(description).state_dict()
    record = {"agent": dataclasses.asdict(description)}
    return PolicyChooser(run.write_snapshot(0, weights, record))


def test_a_robots_policy_remembers_as_one_in_simulation(
    chooser: PolicyChooser, monkeypatch: pytest.MonkeyPatch
) -> None:
    avoided: list[list[tuple[np.ndarray, float]]] = []
    act = ImagePolicy.act

    def spied(*args: Any, avoid: list[tuple[np.ndarray, float]]) -> np.ndarray:
        avoided.append(avoid)
        return act(*args, avoid=avoid)

    monkeypatch.setattr(ImagePolicy, "act", spied)

    def chosen(x: float) -> PickPlaceAction:
        mask = TASK.mask(chain(x))
        view = np.zeros((*mask.shape, 3), np.uint8)
        action = chooser.choose(Observation(0, view, mask, GOAL, None))
        assert action is not None
        return action

    tried = [chosen(0.45) for _ in range(4)]
    gaps = [np.subtract(a.pick_xy, b.pick_xy) for a, b in combinations(tried, 2)]
    assert np.linalg.norm(gaps, axis=1).min() >= MISSED
    chosen(0.52)
    discs = avoided[-1]
    assert [(tuple(xy), reach) for xy, reach in discs] == [(tried[-1].place_xy, PUT_DOWN)]
    chooser.reset()
    assert chosen(0.45) == tried[0] and not avoided[-1]
