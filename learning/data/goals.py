"""Which goals may be learnt: not those of tests, nor such as show what goals of tests do not.

What `train` learns from is checked here, and what `correct` plays for.
"""

from __future__ import annotations

from warp_deform.episodes import EpisodeInfo
from warp_deform.errors import InputError
from warp_deform.tasks.task import Task

__all__ = ["TEST_GOALS", "check_goal", "check_goals_are_given", "goal_is_elsewhere", "making_goals"]

TEST_GOALS = range(100_000, 200_000)
"""Seeds of goals of tests and validation, see `evaluation.protocol`, which needs the simulator."""


def check_goal(
    task: Task, *, seed: int, kind: str, goal: int, learnt: bool, advice: str, what: object
) -> None:
    """Refuse an episode for its goal.

    Args:
        seed: of the episode
        kind: of its goal, "constructed" or "demonstrated"
        goal: seed that the goal was made from
        learnt: whether this is the goal that an agent learns with
        advice: what to do instead
        what: names the episode in an error

    Raises:
        InputError: the goal is one of tests or validation, or is learnt though it was made of the
            episode's start and shows the rest of it, too.
    """
    if goal in TEST_GOALS:
        raise InputError(
            f"the goal of {what} is of seed {goal}, one of those of tests and validation; {advice}"
        )
    if learnt and kind == "constructed" and goal == seed and task.goal_shows_its_start():
        raise InputError(
            f"the goal of {what} is made of its own start and shows the rest of it, too, which "
            f"goals of tests do not; {advice}"
        )


def check_goals_are_given(task: Task, *, given: bool, advice: str) -> None:
    """Refuse to learn with goals of the starts' own where they show what goals of tests do not.

    Raises:
        InputError: none are given, see `Task.goal_shows_its_start`.
    """
    if not given and task.goal_shows_its_start():
        raise InputError(
            f"a goal of {task.name} that is made of its own start shows the rest of it, too, which "
            f"goals of tests do not; {advice}"
        )


def making_goals(task: Task) -> str:
    """The command that makes goals to learn with.

    Examples:
        >>> from warp_deform.tasks.registry import task
        >>> making_goals(task("bag-color-goal"))
        'warp-deform goals bag-color-goal --kind constructed --seed 200000'
    """
    return f"warp-deform goals {task.name} --kind constructed --seed {TEST_GOALS.stop}"


def goal_is_elsewhere(info: EpisodeInfo) -> bool:
    """Whether an episode's goal was made of another seed than its start."""
    return info.goal is not None and int(info.goal["seed"]) != info.seed
