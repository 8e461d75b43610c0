"""`GOAL_GIVEN`: the key of an episode file that says whether its goal was given to its start."""

from __future__ import annotations

from . import EpisodeInfo

__all__ = ["GOAL_GIVEN", "goal_is_own"]

GOAL_GIVEN = "goal_given"
"""Key of `EpisodeInfo.extra`: the start was drawn for the goal. Without, it made the goal."""


def goal_is_own(info: EpisodeInfo) -> bool:
    """Whether an episode's start made its goal; of what was recorded elsewhere, its end.

    Files of earlier releases do not say so: of these it is if both have the same seed.
    """
    return (
        info.goal is not None
        and int(info.goal["seed"]) == info.seed
        and not info.extra.get(GOAL_GIVEN, False)
    )
