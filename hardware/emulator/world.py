"""What surrounds the emulated hand: the hook for contact forces and things to grasp.

A world is stepped once per millisecond of simulated time with the hand's pose and the gripper's
width, and answers with the contact on the hand. In lock-step mode simulated time passes only while
the arm or the gripper moves; in paced mode it always passes. A world runs in the emulator's
process; `EmulatorProcess.call_world` calls its methods from outside. A step has to stay well under
the second after which the client takes the robot for lost, and in paced mode under a millisecond.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from warp_deform.errors import InputError


@dataclass(frozen=True)
class Hand:
    """Where the hand is at the end of a time step.

    Attributes:
        base_T_tcp: pose of the point between the fingertips, shape (4, 4) [m]
        velocity: linear velocity of that point in the base frame, shape (3,) [m/s]
        gripper_width: opening between the fingers [m]
        closing: whether the fingers are closing or holding with force
        dt: length of the step [s]
    """

    base_T_tcp: np.ndarray
    velocity: np.ndarray
    gripper_width: float
    closing: bool
    dt: float


@dataclass(frozen=True)
class Contact:
    """What the world does to the hand.

    Attributes:
        wrench: force [N] and torque [N m] on the hand at the TCP, in the base frame, six numbers
        object_width: width of what lies between the fingers [m]; 0 where nothing does
    """

    wrench: tuple[float, ...] = (0.0,) * 6
    object_width: float = 0.0


class World(Protocol):
    """Anything that answers a hand with a contact."""

    def step(self, hand: Hand) -> Contact:
        """Advance by `hand.dt` and return the contact at the end of the step."""
        ...


class TableWorld:
    """A table of linear stiffness, and optionally something between the fingers wherever they are.

    The force is `stiffness * depth + damping * speed into the table`, never pulling.

    Args:
        table_z: height of the table under the TCP [m]; None for no table
        object_width: width of what the fingers find when they close [m]; 0 for nothing
        stiffness: of the table [N/m]
        damping: of the table [N s/m]
    """

    def __init__(
        self,
        *,
        table_z: float | None = None,
        object_width: float = 0.0,
        stiffness: float = 5000.0,
        damping: float = 50.0,
    ) -> None:
        if not 0.0 <= object_width <= 0.08:
            raise InputError(f"object_width: 0 to 0.08 m fits between the fingers, {object_width}")
        if table_z is not None and not math.isfinite(table_z):
            raise InputError(f"table_z: a height [m], or None for no table, not {table_z}")
        self.table_z = table_z
        self.object_width = object_width
        self._stiffness = stiffness
        self._damping = damping

    def place_object(self, width: float) -> None:
        """Put something `width` [m] wide between the fingers; 0 takes it away."""
        self.object_width = width

    def step(self, hand: Hand) -> Contact:
        """Return the table's push and the object's width."""
        if self.table_z is None:
            return Contact(object_width=self.object_width)
        depth = self.table_z - float(hand.base_T_tcp[2, 3])
        push = self._stiffness * depth - self._damping * float(hand.velocity[2])
        force = max(push, 0.0) if depth > 0.0 else 0.0
        return Contact((0.0, 0.0, force, 0.0, 0.0, 0.0), self.object_width)
