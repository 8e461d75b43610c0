"""One episode through the vendor's client on the emulated arm, asked for at the page alone."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.emulator_worlds import TABLE_Z
from fixtures.franka_episodes import CALIBRATION, GOAL, Listed, drawn_camera, recorder
from fixtures.operator_desk import Desk, answer, desk, question
from fixtures.page_server import hear
from fixtures.safety_spy import joints_at, pose

from hardware.arm.limits import SafetyLimits
from hardware.arm.pick_place import PickPlaceAction
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from hardware.episodes.episode import EpisodeConfig, run_episode

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(240)]
LIMITS = SafetyLimits(table=TablePlane(TABLE_Z - 0.009), max_joint_speed=0.2)
ACTION = PickPlaceAction((0.42, -0.12), 0.4, (0.55, 0.10), 0.9)
# Down from the vendor's home pose takes most of a motion; from 0.1 m above the table, little.
LOW = joints_at(pose(0.45, 0.0, TABLE_Z + 0.1))
FROM_LOW = replace(CALIBRATION, home_q=LOW)


class Person(threading.Thread):
    """Leaves without a word, comes back, answers too late, then says yes.

    Attributes:
        moved: how many steps the arm had made when the yes was given
    """

    def __init__(self, at: Desk, emulator: EmulatorProcess) -> None:
        super().__init__(daemon=True)
        self.at, self.emulator = at, emulator
        self.moved: list[int] = []
        self.notes: list[str] = []

    def run(self) -> None:
        with self.at.server.tab() as tab:
            question(tab)
        with self.at.server.tab() as tab:
            asked = question(tab)
            answer(tab, {**asked, "number": asked["number"] - 1}, "yes")
            self.notes.append(hear(tab, "note")["text"])
            record = self.emulator.call_world("take")
            self.moved.append(int((record["speed"] > 1e-6).sum()))
            answer(tab, {**asked, "beat": hear(tab, "beat")["beat"]}, "yes")
            hear(tab, "closed")


def test_an_episode_is_asked_for_at_the_page_and_nothing_moves_before(
    emulator: EmulatorProcess, ready_panda: PandaRobot, tmp_path: Path
) -> None:
    emulator.call_world("place_object", width=0.004)
    emulator.place(LOW)
    with desk() as at, recorder(tmp_path / "a") as made, drawn_camera(lambda: 0.45) as camera:
        person = Person(at, emulator)
        person.start()
        at.operator.begin(FROM_LOW)
        result = run_episode(
            SafeRobot(ready_panda, LIMITS, home_q=LOW),
            camera,
            FROM_LOW,
            Listed([ACTION]),
            recorder=made,
            goal=GOAL,
            config=EpisodeConfig(max_actions=1),
            operator=at.operator,
            say=at.operator.say,
            show=at.operator.look,
        )
        person.join(10)
    assert (result.outcomes, result.outcome) == (("placed",), "limit")
    assert "not open any more" in person.notes[0] and person.moved == [0]
    assert (emulator.call_world("take")["speed"] > 1e-6).sum() > 1000
    np.testing.assert_allclose(ready_panda.state().q, LOW, atol=1e-3)
