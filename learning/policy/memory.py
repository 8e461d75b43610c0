"""What a policy remembers within an episode, in simulation and on a robot alike.

A policy that sees one picture only would repeat a missed grasp for ever, or pull the same end to
and fro. A cable that crosses itself shows a longer cycle: pulled by one end and then by the other,
it is dragged along each time, and the loop in its middle stays. What the policy remembers tells it
where not to pick next; nothing is taken from the simulator.
"""

from __future__ import annotations

import numpy as np

__all__ = ["MISSED", "PUT_DOWN", "REPEATED", "RESTING", "Memory"]

MISSED = 0.008
"""Around a pick that changed nothing [m]: a bead's diameter and more."""
PUT_DOWN, RESTING = 0.02, 2
"""What was put down within so many metres by so many of the last actions is left alone."""
REPEATED = 0.02
"""Two actions are the same whose picks and whose places are within this of each other [m]. What was
done twice was undone in between: as far around its pick nothing is picked in the next actions, as
many as `RESTING`."""
_MOST_TRIED = 20


class Memory:
    """Actions since the picture last changed, and those that changed it."""

    def __init__(self) -> None:
        self._tried: list[tuple[np.ndarray, np.ndarray]] = []
        self._done: list[tuple[np.ndarray, np.ndarray]] = []

    def avoid(self, *, changed: bool) -> list[tuple[np.ndarray, float]]:
        """Points (2,) and distances [m] from them within which nothing is to be picked.

        Args:
            changed: whether the picture shows something else than before the last action
        """
        if changed:
            self._done += self._tried[-1:]
            self._tried = []
        missed = [(pick, MISSED) for pick, _ in self._tried[-_MOST_TRIED:]]
        resting = [(place, PUT_DOWN) for _, place in self._done[-RESTING:]]
        return missed + resting + [(pick, REPEATED) for pick in self._repeated()]

    def _repeated(self) -> list[np.ndarray]:
        """Picks (2,) [m] of the last actions that did again what one before had done."""
        return [
            pick
            for number, (pick, place) in list(enumerate(self._done))[-RESTING:]
            if any(
                np.linalg.norm(pick - before) < REPEATED and np.linalg.norm(place - then) < REPEATED
                for before, then in self._done[:number]
            )
        ]

    def chose(self, pick: np.ndarray, place: np.ndarray) -> None:
        """Remember an action's pick and place x, y (2,) [m]."""
        self._tried.append((np.array(pick), np.array(place)))
