"""The simulated robot behind `SafeRobot`, its joints recorded at every step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from safety_spy import HOME

from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.emulator.world import Contact, Hand, TableWorld
from hardware.twin.robot import SimRobot, SimRobotConfig

DT = 2e-3  # [s]


class Watched(TableWorld):
    """A world that keeps the joints' positions, and may call back in the middle of a motion."""

    def __init__(self) -> None:
        super().__init__()
        self.q: list[np.ndarray] = []
        self.robot: SimRobot | None = None
        self.at: dict[int, Callable[[], object]] = {}

    def step(self, hand: Hand) -> Contact:
        assert self.robot is not None
        self.q.append(self.robot.state().q)
        self.at.pop(len(self.q), lambda: None)()
        return super().step(hand)


def watched(limits: SafetyLimits, *, q: np.ndarray = HOME) -> tuple[SafeRobot, Watched]:
    world = Watched()
    world.robot = SimRobot(world, SimRobotConfig(q=tuple(q), dt=DT))
    return SafeRobot(world.robot, limits), world
