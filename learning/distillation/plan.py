"""How a budget is spent: numbers of demonstrations, steps, corrected episodes and validations.

A plan is made once, from costs measured on the machine, and kept. All that follows depends on the
plan and not on the clock, so what goes on after an interruption comes to the same bits, and so does
another run by the same plan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError

from ..runs.folder import read_json

__all__ = ["FEW", "FIRST", "Costs", "Plan", "make_plan", "read_plan"]

FIRST, FEW = 2, 10
"""Demonstrations that are collected before costs are measured, as kernels load then, and until they
are; a plan has at least so many."""
_MOST_DEMOS = 40
_MARGIN = 0.92
"""Share of the budget that is planned with: loading, compiling and pictures cost something too."""
_SHARES = {"demos": 0.08, "corrections": 0.27, "validation": 0.13, "steps": 0.52}
_LAST = 0.4
"""Share of the steps after the last correction."""
_ROUNDS = 3
_LEAST_EPISODES = 20
"""Corrected episodes of a round, unless there is but one round."""
_PLAYED = 0.6
"""Actions of an episode that a policy plays, as a share of the most."""
_ACTING = 0.8
"""Cost of choosing an action, in steps of training; the networks run forward alone, once a pick."""
_MOST_SNAPSHOTS, _LEAST_VALIDATION, _MOST_VALIDATION = 4, 15, 50
"""Fewer than so many episodes choose by luck. Then the last snapshot is taken."""


@dataclass(frozen=True, kw_only=True)
class Costs:
    """CPU seconds, measured.

    Attributes:
        start: spent before the plan
        demonstration: a demonstration, refined if it is to be
        action: a demonstrator's action, carried out
        step: a step of training
    """

    start: float
    demonstration: float
    action: float
    step: float


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is done, in numbers.

    Attributes:
        demos: demonstrations
        round_steps: steps of training before each round of corrections
        round_episodes: corrected episodes of each round
        last_steps: steps of training after the last round
        snapshots: of the last training
        validation: episodes that each of them plays; where there is one, it is taken in any case
    """

    demos: int
    round_steps: tuple[int, ...]
    round_episodes: tuple[int, ...]
    last_steps: int
    snapshots: int
    validation: int

    def __post_init__(self) -> None:
        if len(self.round_steps) != len(self.round_episodes):
            raise InputError("a plan needs as many round_steps as round_episodes")
        numbers = (*self.round_steps, *self.round_episodes, self.demos, self.last_steps,
                   self.snapshots, self.validation)  # fmt: skip
        if not all(type(n) is int and n >= 1 for n in numbers):
            raise InputError(f"a plan's numbers must be whole and 1 or more, not {asdict(self)}")


def make_plan(minutes: float, costs: Costs, *, max_actions: int) -> Plan:
    """The plan for a budget of CPU minutes.

    Args:
        max_actions: that an episode of the task may take

    Raises:
        InputError: the budget is too small for anything.

    Examples:
        >>> costs = Costs(start=30, demonstration=0.4, action=0.08, step=0.28)
        >>> plan = make_plan(60, costs, max_actions=20)
        >>> plan.demos, plan.round_steps, plan.round_episodes, plan.last_steps
        (40, (1401, 1401, 1401), (64, 64, 64), 2804)
        >>> plan.snapshots, plan.validation
        (4, 29)
    """
    budget = _MARGIN * 60 * minutes - costs.start
    played = _PLAYED * max_actions * (_ACTING * costs.step + costs.action)
    corrected = played + _PLAYED * max_actions * costs.action
    parts = {name: share * budget for name, share in _SHARES.items()}
    demos = min(_MOST_DEMOS, FEW + max(0, math.floor(parts["demos"] / costs.demonstration)))
    validated = max(0, math.floor(parts["validation"] / played))
    snapshots = min(_MOST_SNAPSHOTS, validated // _LEAST_VALIDATION)
    validation = min(_MOST_VALIDATION, validated // snapshots) if snapshots > 1 else 1
    snapshots = max(snapshots, 1)
    episodes = max(0, math.floor(parts["corrections"] / corrected))
    rounds = min(_ROUNDS, math.ceil(episodes / _LEAST_EPISODES))
    spent = (demos - FEW) * costs.demonstration + episodes * corrected
    steps = math.floor((budget - spent - snapshots * validation * played) / costs.step)
    each = math.floor((1 - _LAST) * steps / rounds) if rounds else 0
    if each < 1:
        raise InputError(
            f"--minutes {minutes:g} is too little: {costs.start / 60:.1f} were spent to measure "
            f"costs, and an episode to correct takes {corrected:.1f} CPU s here; give more"
        )
    return Plan(
        demos=demos,
        round_steps=(each,) * rounds,
        round_episodes=(episodes // rounds,) * rounds,
        last_steps=steps - rounds * each,
        snapshots=snapshots,
        validation=validation,
    )


def read_plan(path: Path) -> Plan:
    """The plan in a file that distilling wrote.

    Raises:
        InputError: there is none.
    """
    return plan_of(read_json(path).get("plan"), what=path)


def plan_of(record: Any, *, what: Path) -> Plan:
    """A plan from its JSON object.

    Raises:
        InputError: it is none.
    """
    names = {field.name for field in fields(Plan)}
    if not isinstance(record, Mapping) or record.keys() != names:
        raise InputError(f"{what} holds no plan of {', '.join(sorted(names))}")
    lists = {name: record[name] for name in ("round_steps", "round_episodes")}
    if not all(isinstance(each, list) for each in lists.values()):
        raise InputError(f"{what}: round_steps and round_episodes must be lists")
    return Plan(**{**record, **{name: tuple(each) for name, each in lists.items()}})
