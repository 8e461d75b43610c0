"""Where an episode of control begins, to go back to it: its state, what is held, its target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..worlds.state import WorldState
from .control_worlds import ControlWorlds

__all__ = ["EpisodeStart", "put_start", "start_of"]


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """What an episode goes on from.

    Attributes:
        state: of the world, under control
        asked: the tip's target (4,) x, y, z [m], yaw [rad]
        floor: lowest height of the tip [m]
        grip: particle or body that it holds
    """

    state: WorldState
    asked: np.ndarray
    floor: float
    grip: tuple[int | None, int | None]


def start_of(control: ControlWorlds, slot: int) -> EpisodeStart:
    """That of a slot which was just reset."""
    return EpisodeStart(
        control.worlds.state(slot),
        control.targets.asked[slot].copy(),
        float(control.targets.floors[slot]),
        control.grips[slot],
    )


def put_start(control: ControlWorlds, slot: int, start: EpisodeStart) -> None:
    """Begin an episode in a slot again, bit for bit."""
    control.worlds.restore(slot, start.state)
    control.targets.place([slot], start.asked[None])
    control.targets.floors[slot], control.grips[slot] = start.floor, start.grip
    control.begin_history(slot)
    control.steps[slot] = 0
