"""What a policy remembers within an episode, in simulation and on a robot alike.

A policy that sees one picture only would repeat a missed grasp for ever, or pull the same end to
and fro. What it remembers tells it where not to pick next; nothing is taken from the simulator.
"""

from __future__ import annotations

import numpy as np

__all__ = ["MISSED", "PUT_DOWN", "RESTING", "Memory"]

MISSED = 0.008
"""Around a pick that changed nothing [m]: a bead's diameter and more."""
PUT_DOWN, RESTING = 0.02, 2
"""What was put down within so many metres by so many of the last actions is left alone."""
_MOST_TRIED = 20


class Memory:
    """Picks since the picture last changed, and where the actions that changed it put things."""

    def __init__(self) -> None:
        self._tried: list[tuple[np.ndarray, np.ndarray]] = []
        self._placed: list[np.ndarray] = []

    def avoid(self, *, changed: bool) -> list[tuple[np.ndarray, float]]:
        """Points (2,) and distances [m] from them within which nothing is to be picked.

        Args:
            changed: whether the picture shows something else than before the last action
        """
        if changed:
            self._placed += [place for _, place in self._tried[-1:]]
            self._tried = []
        discs = [(pick, MISSED) for pick, _ in self._tried[-_MOST_TRIED:]]
        return discs + [(place, PUT_DOWN) for place in self._placed[-RESTING:]]

    def chose(self, pick: np.ndarray, place: np.ndarray) -> None:
        """Remember an action's pick and place x, y (2,) [m]."""
        self._tried.append((np.array(pick), np.array(place)))
