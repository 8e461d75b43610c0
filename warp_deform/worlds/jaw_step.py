"""One action of tasks whose robot has a parallel jaw: what `Worlds.step` does for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ..objects.cable import Cable
from ..objects.scene_object import SceneObject
from ..robots.jaw import Jaw
from ..robots.jaw_primitive import jaw_motion, jaw_script, run_scripts
from ..robots.primitive import Outcome
from ..rollout.rollouts import rollout
from .episode import Execution, episode_rng
from .tip_step import ActingWorlds

__all__ = ["jaw_step"]

_STREAM = 100
"""Random streams of what goes wrong in an action start here, one an action."""
_REST = 0.2
"""A world runs at least so long after the hand has gone up [s]."""


class JawWorlds(ActingWorlds, Protocol):
    """What `jaw_step` needs of `worlds.Worlds`."""

    objects: tuple[SceneObject, ...]


def jaw_step(worlds: JawWorlds, executions: Mapping[int, Execution], record: float) -> None:
    """Carry out actions; notes outcomes, rollouts and motions in their executions."""
    config, chain = worlds.task.jaw, worlds.objects[0]
    assert config is not None and isinstance(chain, Cable), "a jaw takes a chain"
    episodes, solver = worlds.episodes, worlds.solver
    motions = {
        slot: jaw_motion(episodes[slot].tip, execution.action, config)
        for slot, execution in executions.items()
    }
    moving = worlds.reachable(executions, motions)
    jaws, scripts = {}, {}
    for slot in moving:
        rng = episode_rng(episodes[slot].seed, _STREAM + len(episodes[slot].actions))
        action = config.disturbed(executions[slot].action, rng)
        jaws[slot] = Jaw(solver, slot, chain, config.fingers, rng=rng)
        scripts[slot] = jaw_script(jaws[slot], action, config)
    for slot, (outcome, run) in run_scripts(solver, jaws, scripts, config, record=record).items():
        jaws[slot].reset()
        executions[slot].outcome = outcome
        executions[slot].held = 0 if outcome is Outcome.PLACED else None  # the chain
        executions[slot].runs.append(run)
    if not moving:
        return
    runs = rollout(
        solver, moving, min_seconds=_REST, max_seconds=_REST + worlds.rest_limit, record=record
    )
    for slot in moving:
        executions[slot].runs.append(runs[slot])
        episodes[slot].at_rest = runs[slot].at_rest
        episodes[slot].tip = np.array(motions[slot].waypoints[-1])
