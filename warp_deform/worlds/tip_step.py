"""One action of tasks whose robot has a tip: what `Worlds.step` does for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from ..robots.arm import Robot
from ..robots.primitive import Motion, Outcome, approach
from ..rollout.rollouts import GripPath, Rollout, rollout
from ..tasks.task import Task
from ..xpbd.fused_xpbd import FusedXPBD
from .episode import ALOFT_EVERY, Carry, Execution, OnCarry, RunningEpisode

__all__ = ["ActingWorlds", "carry_and_release", "lead_down", "tip_step"]

_CALM = 0.2
"""After a release, speeds stay under `calm_speed` for so long [s]: what the released bead's links
and the beads under it had stored is dissipated instead of flinging it."""
_RETREAT_LEAST = 0.3
"""A world runs at least so long after a release, while the tip retreats [s]."""


class ActingWorlds(Protocol):
    """What an action needs of `worlds.Worlds`."""

    task: Task
    robot: Robot
    episodes: dict[int, RunningEpisode]
    rest_limit: float

    @property
    def solver(self) -> FusedXPBD:
        """What runs them."""

    def reachable(
        self, executions: Mapping[int, Execution], motions: Mapping[int, Motion]
    ) -> list[int]:
        """Slots whose arm gets along its motion; notes the others' outcome."""

    def look(self, slot: int) -> None:
        """Take a snapshot of a slot's state."""


def tip_step(
    worlds: ActingWorlds,
    executions: Mapping[int, Execution],
    record: float,
    on_carry: OnCarry | None = None,
) -> None:
    """Carry out actions; notes outcomes, rollouts and motions in their executions.

    Args:
        on_carry: see `Worlds.step`
    """
    carries = lead_down(worlds, executions, record)
    motions, paths = {}, {}
    for slot, carried in carries.items():
        motions[slot], paths[slot] = carried(executions[slot].action)
    moving = worlds.reachable(executions, motions)
    if not moving:
        return
    if on_carry is not None:
        on_carry({slot: executions[slot].report_of_approach() for slot in moving})
    runs = carry_and_release(worlds, {slot: paths[slot] for slot in moving}, record)
    for slot in moving:
        executions[slot].placed(runs[slot], carries[slot], paths[slot])
        worlds.episodes[slot].at_rest = runs[slot].at_rest
        worlds.episodes[slot].tip = motions[slot].waypoints[-1]


def carry_and_release(
    worlds: ActingWorlds, paths: Mapping[int, GripPath], record: float = 0.0
) -> dict[int, Rollout]:
    """Lead what is held along a path in every slot, let it go, and let the worlds come to rest."""
    return rollout(
        worlds.solver,
        list(paths),
        paths=paths,
        min_seconds=_RETREAT_LEAST,
        max_seconds={
            slot: float(path.times[-1]) + worlds.rest_limit for slot, path in paths.items()
        },
        calm_after=_CALM,
        record=record or (ALOFT_EVERY if worlds.task.looks_aloft else 0.0),
    )


def lead_down(
    worlds: ActingWorlds, executions: Mapping[int, Execution], record: float = 0.0
) -> dict[int, Carry]:
    """Move the tips over the pick points and down to what they meet there.

    Returns how those that have reached something would carry it, by slot.
    """
    task, episodes, config = worlds.task, worlds.episodes, worlds.task.primitive
    motions = {}
    for slot, execution in executions.items():
        pick = execution.action[:3]
        grasp = execution.grasp(task, episodes[slot].snapshot)
        hover = worlds.robot.hover_height(pick[0], pick[1], config.hover)
        height = grasp.height if grasp else 0.0
        motions[slot] = approach(episodes[slot].tip, pick, hover, height, config)
    moving = worlds.reachable(executions, motions)
    waits = {slot: motions[slot].seconds for slot in moving}
    runs = rollout(worlds.solver, moving, min_seconds=1e3, max_seconds=waits, record=record)
    for slot in moving:
        executions[slot].runs.append(runs[slot])
        executions[slot].outcome = Outcome.MISSED
        episodes[slot].tip = motions[slot].waypoints[-2]
        worlds.look(slot)
    radii, carries = worlds.solver.data.topologies[0].particle_radius, {}
    for slot in moving:
        snapshot = episodes[slot].snapshot
        grasp = executions[slot].grasp(task, snapshot)
        if grasp is not None:
            carries[slot] = Carry(grasp, task, worlds.robot, snapshot, radii)
    return carries
