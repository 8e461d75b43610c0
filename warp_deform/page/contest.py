"""The person beside somebody else on the same seeds: a small table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["Contest", "Standing"]

MOST_SEEDS = 50
"""Seeds that the table keeps, the latest ones."""


@dataclass(frozen=True)
class Standing:
    """How far somebody came in an episode."""

    score: float
    actions: int
    solved: bool


class Contest:
    """Standings by seed and by who played."""

    def __init__(self) -> None:
        self._of: dict[int, dict[str, Standing]] = {}

    def note(self, seed: int, who: str, standing: Standing) -> None:
        """Keep a standing; of one's own on a seed, the latest."""
        row = self._of.pop(seed, {})
        row[who] = standing
        self._of[seed] = row
        while len(self._of) > MOST_SEEDS:
            del self._of[next(iter(self._of))]

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, the latest seed first, as JSON."""
        return [
            {"seed": seed, "who": who, **vars(standing)}
            for seed, row in reversed(self._of.items())
            for who, standing in row.items()
        ]
