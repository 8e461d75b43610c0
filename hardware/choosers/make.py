"""`make_chooser`: from the name of an agent on the command line, `--agent`, to its chooser."""

from __future__ import annotations

from pathlib import Path
from typing import assert_never

import numpy as np

from warp_deform.errors import InputError

from ..episodes.episode import Chooser
from ..episodes.goals import GoalMask
from ..rig.config import ChooserName
from ..rig.rig import Rig
from .human import HumanChooser, Show, click_pick_and_place, type_pick_and_place
from .simple import PolicyChooser, RandomChooser, ScriptedChooser

__all__ = ["make_chooser"]


def make_chooser(
    agent: ChooserName,
    rig: Rig,
    goal: GoalMask | None,
    *,
    seed: int,
    policy: Path | None = None,
    budget: int | None = None,
    show: Show = click_pick_and_place,
) -> Chooser:
    """Return the chooser that `--agent` names.

    Args:
        agent: the name
        rig: its view is the workspace; `scripted` reads the simulated chain from it
        goal: what is to be reached; None where there is none
        seed: of random draws
        policy: training run or snapshot, of the agent "policy" alone
        budget: simulated actions for each real one, of the agent "planner"; default: its own
        show: where a person points, of the agent "human"; default: in a window

    Raises:
        InputError: an agent that needs what there is not
    """
    if (policy is None) == (agent == "policy"):
        raise InputError("--agent policy needs --policy, a training run; no other agent takes it")
    if agent == "policy":
        assert policy is not None
        return PolicyChooser(policy, view=rig.view)
    if agent == "random":
        return RandomChooser(np.random.default_rng(seed), view=rig.view)
    if agent == "scripted":
        if rig.look is None:
            raise InputError("--agent scripted knows the simulated chain; it needs --camera sim")
        if goal is None or goal.targets is None:
            raise InputError("--agent scripted needs a goal")
        return ScriptedChooser(rig.look, goal.targets)
    if agent == "planner":
        from .planner import PlannerChooser, PlannerConfig

        config = PlannerConfig() if budget is None else PlannerConfig(budget=budget)
        return PlannerChooser(seed=seed, view=rig.view, config=config)
    if agent == "human":
        return HumanChooser(show, view=rig.view)
    if agent == "typed":
        return HumanChooser(type_pick_and_place, view=rig.view)
    assert_never(agent)
