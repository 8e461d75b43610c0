"""What a snapshot's episodes amount to: rates with their intervals, scores, kinds of failure.

Source: Wilson, JASA 1927.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .paper_results import partial_credit

__all__ = ["FAILURES", "Evaluation", "PlayedEpisode", "best", "measure", "summarise", "wilson"]

FAILURES = ("physics", "missed grasp", "destructive bag action", "item not enclosed",
            "opening covered", "back and forth", "other")  # fmt: skip
"""Kinds of failure, in the order in which `failures.failure` looks for them."""


@dataclass(frozen=True)
class PlayedEpisode:
    """What came of one episode.

    Attributes:
        score: at its end, 0 if its physics cannot be trusted
        reason: why it ended
        failure: which of `FAILURES` it is; None if solved
        goal_l2: for goal-conditioned tasks, `goal_distance` at the start and after every action
        enclosed: `Worlds.enclosed` at the end, whether the bag keeps its items; None also if the
            physics cannot be trusted
    """

    seed: int
    success: bool
    score: float
    actions: int
    reason: str
    failure: str | None = None
    goal_l2: tuple[float, ...] | None = None
    enclosed: bool | None = None


@dataclass(frozen=True)
class Evaluation:
    """A snapshot's episodes in the order of their seeds, and what they amount to."""

    step: int
    episodes: tuple[PlayedEpisode, ...]
    summary: dict[str, Any]


def best(
    evaluations: Sequence[Evaluation], *, task: str, confirmed: Mapping[int, float] | None = None
) -> Evaluation:
    """The evaluation with the best result; of equals the best confirmed one.

    Of those the one with fewer actions, then the latest.

    Args:
        confirmed: by step, share of further episodes that were solved
    """
    further = confirmed or {}

    def rank(each: Evaluation) -> tuple[float, float, float, int]:
        summary = each.summary
        share = further.get(each.step, 0.0)
        return summary[measure(task)], share, -summary["mean_actions"], each.step

    return max(evaluations, key=rank)


def summarise(episodes: Sequence[PlayedEpisode], *, task: str) -> dict[str, Any]:
    """Numbers that episodes amount to.

    n_episodes, n_success, pc_success [%], pc_success_ci95: Wilson's interval [%], mean_score in
    [0, 1] with its standard_error, mean_actions, mean_actions_solved (of successes, None without),
    paper_value [%]: what the paper's table calls success, see `partial_credit`
    failures: how often each of `FAILURES` happened
    goal_l2: mean of the last states' `goal_distance`, None where there is no goal
    n_success_enclosed: successes whose every item the bag enclosed, which scores do not ask for,
    see `Task.enclosed`; None where there is no bag or item
    """
    n, solved = len(episodes), [e for e in episodes if e.success]
    scores = np.array([e.score for e in episodes])
    mean, rate = float(scores.mean()), 100 * len(solved) / n
    failed = Counter(e.failure for e in episodes if e.failure is not None)
    distances = [e.goal_l2[-1] for e in episodes if e.goal_l2]
    bagged = [e for e in episodes if e.enclosed is not None]
    return {
        "n_episodes": n,
        "n_success": len(solved),
        "pc_success": rate,
        "pc_success_ci95": list(wilson(len(solved), n)),
        "mean_score": mean,
        "standard_error": float(scores.std(ddof=1) / math.sqrt(n)) if n > 1 else None,
        "mean_actions": float(np.mean([e.actions for e in episodes])),
        "mean_actions_solved": float(np.mean([e.actions for e in solved])) if solved else None,
        "paper_value": 100 * mean if partial_credit(task) else rate,
        "failures": dict(sorted(failed.items())),
        "goal_l2": float(np.mean(distances)) if distances else None,
        "n_success_enclosed": sum(e.success for e in bagged if e.enclosed) if bagged else None,
    }


def measure(task: str) -> str:
    """The key of a summary by which snapshots of a task are compared."""
    return "mean_score" if partial_credit(task) else "pc_success"


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval [%] of a share of successes.

    Examples:
        >>> [round(bound, 1) for bound in wilson(15, 20)]
        [53.1, 88.8]
    """
    from scipy.stats import binomtest  # slow to import

    interval = binomtest(successes, n).proportion_ci(method="wilson")
    return 100 * float(interval.low), 100 * float(interval.high)
