"""Which goals may be learnt: not those of tests, nor such as show what goals of tests do not.

What `train` learns from is checked here, and what `correct` plays for.
"""

from __future__ import annotations

from collections.abc import Iterable

from warp_deform.episodes import EpisodeInfo
from warp_deform.episodes.goals import goal_is_own
from warp_deform.errors import InputError
from warp_deform.tasks.task import Task

__all__ = [
    "LEARNT_GOALS",
    "TEST_GOALS",
    "check_goals_are_given",
    "given_goals",
    "making_goals",
    "refuse_own_goal",
    "refuse_test_goal",
]

TEST_GOALS = range(100_000, 200_000)
"""Seeds of goals of tests, see `evaluation.protocol`, which needs the simulator."""
LEARNT_GOALS = TEST_GOALS.stop
"""First seed of goals to learn with."""
_SHOWS = "shows the rest of that start, too, which goals of tests do not"


def refuse_test_goal(seed: int, *, what: object, advice: str) -> None:
    """Raise InputError if a goal of this seed is one of tests.

    Args:
        what: names who goes for it
        advice: what to do instead
    """
    if seed in TEST_GOALS:
        raise InputError(
            f"the goal of {what} is of seed {seed}, one of those of tests "
            f"({TEST_GOALS.start} to {TEST_GOALS.stop - 1}); {advice}"
        )


def refuse_own_goal(info: EpisodeInfo, task: Task, *, what: object, advice: str) -> None:
    """Raise InputError if an episode's goal shows what a test's does not.

    It does where its start made it, see `Task.goal_shows_its_start`.
    """
    if task.goal_shows_its_start() and goal_is_own(info):
        raise InputError(f"the goal of {what} is of its own start and {_SHOWS}; {advice}")


def check_goals_are_given(task: Task, *, given: bool, advice: str) -> None:
    """Raise InputError where starts would make goals that show what a test's do not."""
    if task.goal_shows_its_start() and not given:
        raise InputError(f"a goal of {task.name} that a start makes itself {_SHOWS}; {advice}")


def making_goals(task: Task) -> str:
    """The command that makes goals to learn with.

    Examples:
        >>> from warp_deform.tasks.registry import task
        >>> making_goals(task("bag-color-goal"))
        'warp-deform goals bag-color-goal -n 100 --kind constructed --seed 200000 --out goals'
    """
    which = f"-n 100 --kind constructed --seed {LEARNT_GOALS}"
    return f"warp-deform goals {task.name} {which} --out goals"


def given_goals(infos: Iterable[EpisodeInfo]) -> list[int]:
    """Seeds of the goals that were given to episodes, one for each of these episodes."""
    return [
        int(info.goal["seed"]) for info in infos if info.goal is not None and not goal_is_own(info)
    ]
