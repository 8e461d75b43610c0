"""Worlds for the tests of the emulator; its process imports them from here."""

from __future__ import annotations

import numpy as np

from hardware.emulator import Contact, Hand, TableWorld
from warp_deform.xpbd.guards import PhysicsError, Problem, ProblemKind

TABLE_Z = 0.10


class RecordingWorld(TableWorld):
    """A table 10 cm up, and a record of the hand since the last `take`."""

    def __init__(self) -> None:
        super().__init__(table_z=TABLE_Z)
        self.hands: list[Hand] = []
        self.forces: list[float] = []

    def step(self, hand: Hand) -> Contact:
        contact = super().step(hand)
        self.hands.append(hand)
        self.forces.append(contact.wrench[2])
        return contact

    def overstretch(self) -> None:
        """Fail as a simulation fails that cannot be trusted."""
        raise PhysicsError((Problem(ProblemKind.STRETCH, 0, 2.0, 1.5),))

    def take(self) -> dict[str, np.ndarray]:
        """Positions (N, 3) [m], speeds (N,) [m/s], widths (N,) [m] and forces (N,) [N]."""
        record = {
            "position": np.array([hand.base_T_tcp[:3, 3] for hand in self.hands]).reshape(-1, 3),
            "speed": np.array([np.linalg.norm(hand.velocity) for hand in self.hands]),
            "width": np.array([hand.gripper_width for hand in self.hands]),
            "force": np.array(self.forces),
            "dt": np.array([hand.dt for hand in self.hands]),
        }
        self.hands, self.forces = [], []
        return record
