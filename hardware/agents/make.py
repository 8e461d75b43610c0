"""`make_chooser`: the chooser of actions that `--agent` names on the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_deform.errors import InputError

from ..episodes.episode import Chooser
from ..episodes.goals import GoalSeen
from ..rig.config import AgentName
from ..rig.rig import Rig
from .choosers import PolicyChooser, RandomChooser, ScriptedChooser
from .human import HumanChooser, clicked, typed

__all__ = ["make_chooser"]


def make_chooser(
    agent: AgentName,
    rig: Rig,
    goal: GoalSeen | None,
    *,
    seed: int,
    policy: Path | None = None,
    budget: int | None = None,
) -> Chooser:
    """Return who chooses.

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
    return HumanChooser(clicked if agent == "human" else typed, view=rig.view)
