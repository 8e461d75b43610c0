"""The paper's table of results, and what it calls a result of a task."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PARTIAL_SCORE", "SUCCESS", "PaperResults", "partial_credit", "read_paper"]

SUCCESS, PARTIAL_SCORE = "success", "mean partial score"
"""What the table shows for a task: the share of episodes solved, or the mean of the last scores."""


@dataclass(frozen=True)
class PaperResults:
    """The paper's table.

    Attributes:
        measures: `SUCCESS` or `PARTIAL_SCORE` by task
        values: by task, agent, number of demonstrations [%]
    """

    source: str
    protocol: str
    demos: tuple[int, ...]
    measures: Mapping[str, str]
    values: Mapping[tuple[str, str, int], float]

    def agents(self, task: str) -> list[str]:
        """Agents that the table has for a task, in its order."""
        return list(dict.fromkeys(agent for name, agent, _ in self.values if name == task))


@functools.cache
def read_paper() -> PaperResults:
    """The paper's table, from the data file beside this module."""
    data = json.loads((Path(__file__).parent / "paper_results.json").read_text())
    values = {
        (task, agent, demos): value
        for task, entry in data["tasks"].items()
        for agent, row in entry["agents"].items()
        for demos, value in zip(data["demos"], row, strict=True)
    }
    return PaperResults(
        source=data["source"],
        protocol=data["protocol"],
        demos=tuple(data["demos"]),
        measures={task: entry["measure"] for task, entry in data["tasks"].items()},
        values=values,
    )


def partial_credit(task: str) -> bool:
    """Whether a task's result is the mean score; that of tasks outside of the table is successes.

    Examples:
        >>> partial_credit("fabric-flat"), partial_credit("cable-ring")
        (True, False)
    """
    return read_paper().measures.get(task) == PARTIAL_SCORE
